#version 460
// Writes a frame's counts for the host, and whether all its intersections fitted into the buffers.
// A training step whose frame did not fit must change nothing.

layout(local_size_x = 1) in;

layout(std430, binding = 0) readonly buffer VisibleCount { uint visible_count[]; };
layout(std430, binding = 1) readonly buffer Total { uint total[]; };
layout(std430, binding = 2) writeonly buffer Counts { uint counts[]; };
layout(std430, binding = 3) writeonly buffer Fits { uint fits[]; };

layout(push_constant) uniform Params { uint capacity; };

void main() {
    counts[0] = visible_count[0];
    counts[1] = total[0];
    fits[0] = total[0] <= capacity ? 1u : 0u;
}
