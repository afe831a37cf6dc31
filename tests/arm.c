// Calls a kernel's handler as XLA does: reads its arrays from stdin, as tests/arm.py describes them, and writes its
// results, but for the last, its workspace, to stdout.

#include <stdint.h>
#include <stdio.h>
#include <stdlib.h>

#include "xla/ffi/api/c_api.h"

enum { MOST = 512 };

XLA_FFI_Error* handler(XLA_FFI_CallFrame* frame);

static void take(void* to, size_t bytes) {
  if (bytes && fread(to, bytes, 1, stdin) != 1) exit(2);
}

static size_t bytes[MOST];
static XLA_FFI_Buffer buffers[MOST];
static void* pointers[MOST];

// Returns whether there was another array.
static int take_array(int i) {
  int64_t rank, size;
  if (fread(&rank, sizeof rank, 1, stdin) != 1) return 0;
  if (i == MOST) exit(3);
  buffers[i].rank = rank;
  buffers[i].dims = malloc((rank + 1) * sizeof *buffers[i].dims);
  take(buffers[i].dims, rank * sizeof *buffers[i].dims);
  take(&size, sizeof size);
  bytes[i] = size;
  buffers[i].data = aligned_alloc(64, (size + 64) / 64 * 64);
  take(buffers[i].data, size);
  pointers[i] = &buffers[i];
  return 1;
}

int main(void) {
  if (!take_array(0)) return 2;
  int64_t given = *(int64_t*)buffers[0].data;
  int count = 0;
  while (take_array(count)) count++;
  XLA_FFI_CallFrame frame = {.struct_size = sizeof frame};
  frame.args.size = given;
  frame.args.args = pointers;
  frame.rets.size = count - given;
  frame.rets.rets = pointers + given;
  if (handler(&frame)) return 4;
  for (int i = given; i < count - 1; i++) fwrite(buffers[i].data, bytes[i], 1, stdout);
  return 0;
}
