// Memory that a thread keeps between calls, aligned for the vectors of simd.h.
#pragma once

#include <cstddef>
#include <memory>
#include <new>

namespace vdgs {

template <class Scalar>
class Scratch {
 public:
  // At least `size` elements with undefined contents; earlier pointers become invalid.
  Scalar* at_least(size_t size) {
    if (size > size_) {
      memory_.reset();
      memory_.reset(static_cast<Scalar*>(::operator new(size * sizeof(Scalar), kAlignment)));
      size_ = size;
    }
    return memory_.get();
  }

 private:
  static constexpr std::align_val_t kAlignment{64};
  struct Free {
    void operator()(Scalar* p) const { ::operator delete(p, kAlignment); }
  };
  std::unique_ptr<Scalar, Free> memory_;
  size_t size_ = 0;
};

}  // namespace vdgs
