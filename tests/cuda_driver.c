// A driver of NVIDIA's interface that "plays" on this processor: memory is malloc's, code is a shared object behind its length.
#define _GNU_SOURCE
#include <dlfcn.h>
#include <stdint.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <unistd.h>
typedef unsigned long long Place;
static int context;
static void* current;
int cuInit(unsigned flags) { return 0; }
int cuDriverGetVersion(int* version) { *version = 13000; return 0; }
int cuDeviceGet(int* device, int number) { *device = number; return number ? 101 : 0; }
int cuDeviceGetAttribute(int* value, int what, int device) { *value = what == 75 ? 9 : what == 76 ? 0 : 2; return 0; }
int cuDeviceGetName(char* name, int size, int device) { strncpy(name, "Driver's card", size); return 0; }
int cuDevicePrimaryCtxRetain(void** made, int device) { *made = &context; return 0; }
int cuCtxSetCurrent(void* one) { current = one; return 0; }
int cuMemAlloc_v2(Place* at, size_t size) {
  if (current != &context) return 201;
  if (size > (1ull << 32)) return 2;
  *at = (Place)malloc(size);
  return 0;
}
int cuMemFree_v2(Place at) { free((void*)at); return 0; }
int cuMemGetInfo_v2(size_t* left, size_t* all) { *left = 1ull << 33; *all = 1ull << 34; return 0; }
int cuMemsetD8Async(Place at, unsigned char value, size_t size, void* stream) { memset((void*)at, value, size); return 0; }
int cuMemcpyHtoDAsync_v2(Place to, const void* from, size_t size, void* stream) { memcpy((void*)to, from, size); return 0; }
int cuMemcpyDtoHAsync_v2(void* to, Place from, size_t size, void* stream) { memcpy(to, (void*)from, size); return 0; }
int cuMemcpyDtoDAsync_v2(Place to, Place from, size_t size, void* stream) { memcpy((void*)to, (void*)from, size); return 0; }
typedef struct { size_t x, y; int kind; const void* host; Place device; void* array; size_t pitch; } Side;
typedef struct { Side from, to; size_t width, height; } Rows;
int cuMemcpy2DAsync_v2(const Rows* rows, void* stream) {
  const Side *from = &rows->from, *to = &rows->to;
  if (from->kind == to->kind || from->x || from->y || to->x || to->y) return 1;
  const char* a = from->kind == 1 ? from->host : (const char*)from->device;
  char* b = to->kind == 1 ? (char*)to->host : (char*)to->device;
  for (size_t i = 0; i < rows->height; i++) memcpy(b + i * to->pitch, a + i * from->pitch, rows->width);
  return 0;
}
int cuStreamSynchronize(void* stream) { return 0; }
int cuModuleLoadData(void** module, const void* image) {
  size_t size;
  memcpy(&size, image, 8);
  char name[] = "/tmp/tailgate-driver-XXXXXX";
  int file = mkstemp(name);
  if (write(file, (const char*)image + 8, size) != (long)size) return 1;
  close(file);
  *module = dlopen(name, RTLD_NOW);
  unlink(name);
  return *module ? 0 : 200;
}
int cuModuleGetFunction(void** found, void* module, const char* name) {
  char full[100];
  snprintf(full, sizeof full, "launch_%s", name);
  *found = dlsym(module, full);
  return *found ? 0 : 500;
}
int cuFuncGetAttribute(int* value, int what, void* kernel) { *value = what; return 0; }
int cuOccupancyMaxActiveBlocksPerMultiprocessor(int* blocks, void* kernel, int threads, size_t shared) { *blocks = 2; return 0; }
int cuLaunchKernel(void* kernel, unsigned x, unsigned y, unsigned z, unsigned a, unsigned b, unsigned c, unsigned shared, void* stream,
                   void** given, void** extra) {
  if (y != 1 || z != 1 || b != 1 || c != 1 || shared || extra) return 1;
  ((void (*)(unsigned, unsigned, void**))kernel)(x, a, given);
  return 0;
}
int cuGetProcAddress_v2(const char* name, void** found, int version, uint64_t flags, int* status) {
  char full[200];
  void* own = dlopen("libcuda.so.1", RTLD_NOW | RTLD_NOLOAD);
  snprintf(full, sizeof full, "%s_v2", name);
  *found = own ? dlsym(own, full) : 0;
  if (!*found && own) *found = dlsym(own, name);
  if (status) *status = *found ? 0 : 1;
  return *found ? 0 : 500;
}
