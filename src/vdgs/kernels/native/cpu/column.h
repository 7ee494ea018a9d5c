// An array of which only the greatest length is known beforehand.
#pragma once

#include <cstdint>
#include <cstdlib>
#include <cstring>
#include <new>
#include <utility>

namespace vdgs {

// Allocated for the most that may come; `fit` gives back what did not. What was never written costs address
// space only. Aligned for SIMD.
template <class T>
class Column {
 public:
  explicit Column(size_t most) : base_(std::malloc(most * sizeof(T) + kAlignment)) {
    if (!base_) throw std::bad_alloc();
    align();
  }
  Column(Column&& other) noexcept : base_(std::exchange(other.base_, nullptr)), shift_(other.shift_) {}
  Column& operator=(Column&&) = delete;
  ~Column() { std::free(base_); }

  T* data() const { return reinterpret_cast<T*>(static_cast<char*>(base_) + shift_); }

  // Keeps the first n elements; the common allocators shrink in place.
  void fit(size_t n) {
    void* fitted = std::realloc(base_, n * sizeof(T) + kAlignment);
    if (!fitted) return;  // it stays as large as it was
    base_ = fitted;
    const size_t before = shift_;
    align();
    char* bytes = static_cast<char*>(base_);
    if (shift_ != before) std::memmove(bytes + shift_, bytes + before, n * sizeof(T));
  }

  // Hands the memory over: to be freed with std::free. `data` must have been asked for before.
  void* release() { return std::exchange(base_, nullptr); }

 private:
  static constexpr size_t kAlignment = 64;
  void align() { shift_ = kAlignment - reinterpret_cast<uintptr_t>(base_) % kAlignment; }

  void* base_;
  size_t shift_ = 0;  // where the elements begin, in bytes
};

}  // namespace vdgs
