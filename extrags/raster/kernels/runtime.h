// What the kernels need of the machine: memory that is reused from call to call, and threads.
//
// The kernels are compiled once per instruction set. They may call what is declared here, but share no
// inline code with each other or with the standard library: an inline function is emitted once per
// program, with the instructions of whichever file the linker meets first.
#pragma once

#include <cstddef>
#include <cstdint>

namespace extrags {

// A block of 64-byte aligned memory that only ever grows; contents are not kept when it does.
struct Buffer {
  void* data;
  size_t capacity;
};

// Asks the system for pages of 2 MiB where [data, data + bytes) holds whole ones: large arrays are walked with
// fewer misses of the address translation. Values stay as they are.
void advise_huge_pages(void* data, size_t bytes);

// Makes room for `bytes`. Throws std::bad_alloc.
void reserve(Buffer* buffer, size_t bytes);
void release(Buffer* buffer);

// Entries of a list are numbered in 32 bits. Throws std::overflow_error, which says what `entries` are, where
// there are more; to be called before memory is reserved for them.
void check_countable(uint64_t count, const char* entries);

constexpr int kMaxThreads = 64;

using Task = void (*)(void* context, int task, int slot);

// Runs task(context, i, slot) for i in [0, count), on up to num_threads() threads. `slot` is below
// kMaxThreads and tells concurrent tasks apart. Which thread runs which task is not defined, so tasks must
// not depend on it. When another caller holds the threads, all tasks run on the calling thread.
void parallel_for(int count, Task task, void* context);

// Seconds on a clock that never goes back
double monotonic_seconds();

void set_num_threads(int count);
int num_threads();

}  // namespace extrags
