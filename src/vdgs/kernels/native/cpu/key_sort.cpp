// Least significant digit first, 11 bits at a time; a digit that all keys share is skipped. Every pass counts
// the digits of fixed stretches of the array, adds the counts up, and lets each stretch move its own keys.
#include "key_sort.h"

#include <algorithm>
#include <utility>
#include <vector>

#include "threads.h"

namespace vdgs {
namespace {

constexpr int kDigitBits = 11;
constexpr size_t kDigits = size_t{1} << kDigitBits;
constexpr size_t kLeastStretch = 1 << 14;
constexpr size_t kMostStretches = 32;

struct Stretches {
  size_t n, each;
  explicit Stretches(size_t n) : n(n), each(std::max(kLeastStretch, (n + kMostStretches - 1) / kMostStretches)) {}
  size_t count() const { return (n + each - 1) / each; }
  // body(stretch, begin, end)
  template <class Body>
  void parallel(const Body& body) const {
    parallel_for(static_cast<int64_t>(count()), [&](int64_t task) {
      const size_t begin = static_cast<size_t>(task) * each;
      body(static_cast<size_t>(task), begin, std::min(n, begin + each));
    });
  }
};

// Bits in which any two keys differ.
uint64_t differing_bits(const uint64_t* keys, const Stretches& stretches) {
  std::vector<uint64_t> differing(stretches.count(), 0);
  stretches.parallel([&](size_t stretch, size_t begin, size_t end) {
    uint64_t bits = 0;
    for (size_t i = begin; i < end; ++i) bits |= keys[i] ^ keys[0];
    differing[stretch] = bits;
  });
  uint64_t all = 0;
  for (const uint64_t bits : differing) all |= bits;
  return all;
}

// counts[stretch][digit] becomes the place of the first such key of that stretch.
void counts_to_places(std::vector<uint32_t>& counts, size_t stretches) {
  uint32_t place = 0;
  for (size_t digit = 0; digit < kDigits; ++digit) {
    for (size_t stretch = 0; stretch < stretches; ++stretch) {
      place += std::exchange(counts[stretch * kDigits + digit], place);
    }
  }
}

void pass(const uint64_t* keys, const uint32_t* order, uint64_t* sorted_keys, uint32_t* sorted_order, int shift,
          const Stretches& stretches, std::vector<uint32_t>& counts) {
  const auto digit_of = [shift](uint64_t key) { return (key >> shift) & (kDigits - 1); };
  std::fill(counts.begin(), counts.end(), 0);
  stretches.parallel([&](size_t stretch, size_t begin, size_t end) {
    uint32_t* count = counts.data() + stretch * kDigits;
    for (size_t i = begin; i < end; ++i) ++count[digit_of(keys[i])];
  });
  counts_to_places(counts, stretches.count());
  stretches.parallel([&](size_t stretch, size_t begin, size_t end) {
    uint32_t* places = counts.data() + stretch * kDigits;
    for (size_t i = begin; i < end; ++i) {
      const uint32_t place = places[digit_of(keys[i])]++;
      sorted_keys[place] = keys[i];
      sorted_order[place] = order[i];
    }
  });
}

}  // namespace

void sort_keys(uint64_t* keys, uint32_t* order, size_t n) {
  for (size_t i = 0; i < n; ++i) order[i] = static_cast<uint32_t>(i);
  if (n < 2) return;
  const Stretches stretches(n);
  const uint64_t differing = differing_bits(keys, stretches);
  std::vector<uint32_t> counts(stretches.count() * kDigits);
  uint64_t *from = keys, *to = keys + n;
  uint32_t *from_order = order, *to_order = order + n;
  for (int shift = 0; shift < 64; shift += kDigitBits) {
    if (((differing >> shift) & (kDigits - 1)) == 0) continue;
    pass(from, from_order, to, to_order, shift, stretches, counts);
    std::swap(from, to);
    std::swap(from_order, to_order);
  }
  if (from == keys) return;
  std::copy(from, from + n, keys);
  std::copy(from_order, from_order + n, order);
}

}  // namespace vdgs
