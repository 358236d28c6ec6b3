/*
 * splat4d: 4D Gaussian splatting on Vulkan compute, for programs in C and C++.
 *
 * Made from src/capi by tools/header; do not edit.
 *
 * Three depths, each of which goes with the renderer, the trainer and the ops:
 *
 *   1. The engine's device (splat4d_device_open), its streams, its memory.
 *   2. The host's device (splat4d_device_adopt), the engine's submissions between the host's timeline
 *      semaphores (splat4d_stream_submit), the host's buffers (splat4d_buffer_adopt).
 *   3. The host's command buffers (splat4d_recorder_over).
 *
 * Conventions, of every function unless it says otherwise:
 *
 * - Errors. A splat4d_result, SPLAT4D_OK (0) for success; splat4d_last_error() has the message, per
 *   thread. No panic and no exception crosses the border. NULL where something must be is an error, and
 *   so is a structure of a wrong size. After SPLAT4D_ERROR_INTERNAL and SPLAT4D_ERROR_DEVICE_LOST only
 *   destroying is left for the handles of the call.
 * - Handles. Opaque pointers. Who is given one by a function that creates, opens, adopts, records or
 *   finishes owns it, and destroys it, or hands it to a function that says that it is gone afterwards.
 *   Where such a function fails the handle is NULL. Destroying NULL does nothing, destroying in any
 *   order is fine: everything keeps what it needs. A destroyed handle, or one of another kind, must not
 *   be used; nobody can check that.
 * - Structures begin with their size: set struct_size = sizeof(the structure) and the rest to 0, then
 *   what you want. 0 is the default of whatever has one, also of fields that later versions add, so
 *   that programs run with libraries older and newer than their header.
 * - Arrays and texts given in are copied or read before the function returns: nothing of them is kept.
 *   Texts are UTF-8 with a zero at the end. Arrays have the length that is documented; nobody can
 *   check that either.
 * - Threads. A splat4d_device may be used by any number of threads at once, and nothing is global. Any
 *   other handle may go from thread to thread, and is used by one at a time.
 * - Transforms are named a_from_b. Images are row by row from the upper left; floats are 32 bits.
 */
