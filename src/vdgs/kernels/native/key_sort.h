// Stable sort of 64-bit keys, with the place that each came from.
#pragma once

#include <cstddef>
#include <cstdint>

namespace vdgs {

// Sorts keys[0..n) ascending in place; order[i] becomes the index that sorted key i had before. Stable, so the
// result is unique. n < 2^32. Both arrays hold 2 n elements: the second half is working space.
void sort_keys(uint64_t* keys, uint32_t* order, size_t n);

}  // namespace vdgs
