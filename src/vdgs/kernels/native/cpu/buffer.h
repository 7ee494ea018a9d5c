// Memory that is not initialized, is aligned for SIMD, and is kept for the next use.
#pragma once

#include <cstddef>
#include <cstdint>
#include <cstdlib>
#include <cstring>
#include <new>
#include <utility>

#if defined(__linux__)
#include <sys/mman.h>
#endif

namespace vdgs {

template <class T>
class Buffer {
 public:
  Buffer() = default;
  Buffer(const Buffer&) = delete;
  Buffer& operator=(const Buffer&) = delete;
  ~Buffer() { std::free(data_); }

  // Room for n elements, whose values are not defined.
  T* reserve(size_t n) {
    if (n > capacity_) {
      std::free(data_);
      data_ = nullptr;
      capacity_ = 0;
      data_ = allocate(n + n / 8);
      capacity_ = n + n / 8;
    }
    return data_;
  }

  // Room for n elements, of which the first `used` keep their values.
  T* grow(size_t used, size_t n) {
    if (n > capacity_) {
      T* larger = allocate(2 * n);
      if (used) std::memcpy(static_cast<void*>(larger), data_, used * sizeof(T));
      std::free(data_);
      data_ = larger;
      capacity_ = 2 * n;
    }
    return data_;
  }

  void swap(Buffer& other) {
    std::swap(data_, other.data_);
    std::swap(capacity_, other.capacity_);
  }

  T* data() { return data_; }
  const T* data() const { return data_; }
  T& operator[](size_t i) { return data_[i]; }
  const T& operator[](size_t i) const { return data_[i]; }
  size_t bytes() const { return capacity_ * sizeof(T); }

 private:
  static T* allocate(size_t n) {
    // One line to spare, so that a full vector may be written at the last element.
    const size_t size = (n * sizeof(T) + 127) / 64 * 64;
    void* p = std::aligned_alloc(64, size);
    if (!p) throw std::bad_alloc();
#if defined(__linux__)
    // Large buffers live in large pages: fewer page faults the first time, fewer TLB misses after.
    if (size >= size_t{4} << 20) {
      const uintptr_t page = (reinterpret_cast<uintptr_t>(p) + 4095) & ~uintptr_t{4095};
      madvise(reinterpret_cast<void*>(page), size - 4096, MADV_HUGEPAGE);
    }
#endif
    return static_cast<T*>(p);
  }

  T* data_ = nullptr;
  size_t capacity_ = 0;
};

}  // namespace vdgs
