/*
 * Under AddressSanitizer: libraries stay loaded. A leak's stack then says whose it is, and what an
 * unloaded driver's own statics pointed at does not count as one.
 */
#ifdef __cplusplus
extern "C"
#endif
int dlclose(void *handle);

int dlclose(void *handle)
{
    (void)handle;
    return 0;
}
