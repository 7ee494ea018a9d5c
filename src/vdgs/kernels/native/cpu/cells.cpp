// Cells of space: keys, groups of equal keys, membership by hash, order along a Morton curve.
//
// The meaning is that of torch_ref/cells.py. Keys are computed in float64 with the same operations in the same
// order as there, so that both agree on every position.
#include <algorithm>
#include <atomic>
#include <cmath>
#include <cstdint>
#include <memory>
#include <stdexcept>
#include <vector>

#include "bindings.h"
#include "key_sort.h"
#include "threads.h"

namespace vdgs {
namespace {

constexpr int kAxisBits = 21;
constexpr double kAxisCells = 1 << kAxisBits;
constexpr double kAxisOffset = 1 << (kAxisBits - 1);
constexpr size_t kTask = 1 << 14;

template <class Body>
void parallel_ranges(size_t n, const Body& body) {
  parallel_for(static_cast<int64_t>((n + kTask - 1) / kTask), [&](int64_t task) {
    const size_t begin = static_cast<size_t>(task) * kTask;
    body(begin, std::min(n, begin + kTask));
  });
}

template <class Scalar>
using Positions = Array<const Scalar, nb::shape<-1, 3>>;
using Keys = Array<const int64_t, nb::ndim<1>>;
using KeysOut = Array<int64_t, nb::ndim<1>>;

// ---- keys -------------------------------------------------------------------------------------------

// False where a position does not fit.
template <class Scalar>
bool cell_keys(Positions<Scalar> positions, double cell_size, Array<const double, nb::shape<3>> origin, KeysOut keys) {
  const Scalar* p = positions.data();
  const double* o = origin.data();
  int64_t* out = keys.data();
  std::atomic<bool> fits{true};
  nb::gil_scoped_release release;
  parallel_ranges(positions.shape(0), [&](size_t begin, size_t end) {
    bool all_fit = true;
    for (size_t i = begin; i < end; ++i) {
      int64_t key = 0;
      for (int k = 0; k < 3; ++k) {
        const double index = std::floor((static_cast<double>(p[3 * i + k]) - o[k]) / cell_size) + kAxisOffset;
        const bool fit = index >= 0.0 && index < kAxisCells;  // false for NaN
        all_fit &= fit;
        key = (key << kAxisBits) | static_cast<int64_t>(fit ? index : 0.0);
      }
      out[i] = key;
    }
    if (!all_fit) fits.store(false, std::memory_order_relaxed);
  });
  return fits.load();
}

// ---- groups -----------------------------------------------------------------------------------------

// Working space for sort_keys.
struct Sorted {
  std::unique_ptr<uint64_t[]> keys;
  std::unique_ptr<uint32_t[]> order;
  explicit Sorted(size_t n) : keys(new uint64_t[2 * n]), order(new uint32_t[2 * n]) {
    if (n >> 32) throw std::length_error("more than 2^32 elements");
  }
};

constexpr uint64_t kSign = uint64_t{1} << 63;  // flipped, signed keys sort as unsigned ones

// Writes the distinct keys, ascending, and the group of each key; returns how many are distinct.
size_t group_cells(Keys keys, KeysOut unique, KeysOut group) {
  const size_t n = keys.shape(0);
  const int64_t* in = keys.data();
  int64_t *out = unique.data(), *groups = group.data();
  nb::gil_scoped_release release;
  Sorted sorted(n);
  parallel_ranges(n, [&](size_t begin, size_t end) {
    for (size_t i = begin; i < end; ++i) sorted.keys[i] = static_cast<uint64_t>(in[i]) ^ kSign;
  });
  sort_keys(sorted.keys.get(), sorted.order.get(), n);
  const auto starts = [&](size_t i) { return i == 0 || sorted.keys[i] != sorted.keys[i - 1]; };
  std::vector<size_t> before((n + kTask - 1) / kTask + 1, 0);
  parallel_ranges(n, [&](size_t begin, size_t end) {
    for (size_t i = begin; i < end; ++i) before[begin / kTask + 1] += starts(i);
  });
  for (size_t i = 1; i < before.size(); ++i) before[i] += before[i - 1];
  parallel_ranges(n, [&](size_t begin, size_t end) {
    size_t next = before[begin / kTask];
    for (size_t i = begin; i < end; ++i) {
      if (starts(i)) out[next++] = static_cast<int64_t>(sorted.keys[i] ^ kSign);
      groups[sorted.order[i]] = static_cast<int64_t>(next) - 1;
    }
  });
  return before.back();
}

// Elementwise maximum of the rows of each group, NaN first; a group without rows is 0.
template <class Scalar>
void group_max(Array<const Scalar, nb::ndim<2>> values, Keys group, Array<Scalar, nb::ndim<2>> result) {
  const size_t n = values.shape(0), d = values.shape(1), count = result.shape(0);
  const Scalar* in = values.data();
  const int64_t* groups = group.data();
  Scalar* out = result.data();
  nb::gil_scoped_release release;
  // Rows sorted by group, by counting: members[first[g]] .. members[first[g + 1]].
  std::vector<size_t> first(count + 2, 0), members(n);
  for (size_t i = 0; i < n; ++i) ++first[static_cast<size_t>(groups[i]) + 2];
  for (size_t g = 2; g < first.size(); ++g) first[g] += first[g - 1];
  for (size_t i = 0; i < n; ++i) members[first[static_cast<size_t>(groups[i]) + 1]++] = i;
  const auto reduce = [&](size_t g) {
    Scalar* best = out + g * d;
    if (first[g] == first[g + 1]) return std::fill(best, best + d, Scalar{0});
    const Scalar* row = in + members[first[g]] * d;
    std::copy(row, row + d, best);
    for (size_t member = first[g] + 1; member < first[g + 1]; ++member) {
      row = in + members[member] * d;
      for (size_t k = 0; k < d; ++k) best[k] = row[k] > best[k] || row[k] != row[k] ? row[k] : best[k];
    }
  };
  parallel_ranges(count, [&](size_t begin, size_t end) {
    for (size_t g = begin; g < end; ++g) reduce(g);
  });
}

// ---- membership -------------------------------------------------------------------------------------

// Open addressing with linear probing, at most half full. Threads insert at once: which key sits where depends
// on them, which keys are held does not.
class KeySet {
 public:
  KeySet(const int64_t* keys, size_t n) {
    while (mask_ + 1 < 2 * n) mask_ = 2 * mask_ + 1;
    slots_.reset(new std::atomic<int64_t>[mask_ + 1]);
    parallel_ranges(mask_ + 1, [&](size_t begin, size_t end) {
      for (size_t i = begin; i < end; ++i) slots_[i].store(kEmpty, std::memory_order_relaxed);
    });
    parallel_ranges(n, [&](size_t begin, size_t end) {
      for (size_t i = begin; i < end; ++i) insert(keys[i]);
    });
  }

  bool contains(int64_t key) const {
    if (key == kEmpty) return holds_empty_.load(std::memory_order_relaxed);
    for (size_t slot = hash(key);; slot = (slot + 1) & mask_) {
      const int64_t held = slots_[slot].load(std::memory_order_relaxed);
      if (held == key) return true;
      if (held == kEmpty) return false;
    }
  }

 private:
  static constexpr int64_t kEmpty = INT64_MIN;  // as a key, it is remembered apart

  size_t hash(int64_t key) const {
    uint64_t mixed = static_cast<uint64_t>(key) * 0x9e3779b97f4a7c15u;
    mixed = (mixed ^ (mixed >> 32)) * 0x9e3779b97f4a7c15u;
    return static_cast<size_t>(mixed >> 20) & mask_;
  }

  void insert(int64_t key) {
    if (key == kEmpty) return holds_empty_.store(true, std::memory_order_relaxed);
    for (size_t slot = hash(key);; slot = (slot + 1) & mask_) {
      int64_t held = slots_[slot].load(std::memory_order_relaxed);
      if (held == kEmpty && slots_[slot].compare_exchange_strong(held, key, std::memory_order_relaxed)) return;
      if (held == key) return;
    }
  }

  size_t mask_ = 15;
  std::unique_ptr<std::atomic<int64_t>[]> slots_;
  std::atomic<bool> holds_empty_{false};
};

void contains(Keys table, Keys query, Array<bool, nb::ndim<1>> result) {
  const int64_t* keys = query.data();
  bool* out = result.data();
  nb::gil_scoped_release release;
  const KeySet set(table.data(), table.shape(0));
  parallel_ranges(query.shape(0), [&](size_t begin, size_t end) {
    for (size_t i = begin; i < end; ++i) out[i] = set.contains(keys[i]);
  });
}

// ---- Morton order -----------------------------------------------------------------------------------

// Moves bit i to bit 3i, for 21 bits.
uint64_t spread(uint64_t x) {
  x = (x | x << 32) & 0x1f00000000ffff;
  x = (x | x << 16) & 0x1f0000ff0000ff;
  x = (x | x << 8) & 0x100f00f00f00f00f;
  x = (x | x << 4) & 0x10c30c30c30c30c3;
  return (x | x << 2) & 0x1249249249249249;
}

struct Box {
  double low[3] = {HUGE_VAL, HUGE_VAL, HUGE_VAL}, high[3] = {-HUGE_VAL, -HUGE_VAL, -HUGE_VAL};
  bool finite = true;
};

template <class Scalar>
Box bounding_box(const Scalar* p, size_t n) {
  std::vector<Box> boxes((n + kTask - 1) / kTask);
  parallel_ranges(n, [&](size_t begin, size_t end) {
    Box box;
    for (size_t i = 3 * begin; i < 3 * end; i += 3) {
      for (int k = 0; k < 3; ++k) {
        const double x = p[i + k];
        box.finite &= std::isfinite(x);
        box.low[k] = std::min(box.low[k], x);
        box.high[k] = std::max(box.high[k], x);
      }
    }
    boxes[begin / kTask] = box;
  });
  Box all;
  for (const Box& box : boxes) {
    all.finite &= box.finite;
    for (int k = 0; k < 3; ++k) {
      all.low[k] = std::min(all.low[k], box.low[k]);
      all.high[k] = std::max(all.high[k], box.high[k]);
    }
  }
  return all;
}

template <class Scalar>
void morton_order(Positions<Scalar> positions, KeysOut order) {
  const size_t n = positions.shape(0);
  const Scalar* p = positions.data();
  int64_t* out = order.data();
  nb::gil_scoped_release release;
  const Box box = bounding_box(p, n);
  if (!box.finite) throw std::invalid_argument("a position is not finite");
  const double side = std::max({box.high[0] - box.low[0], box.high[1] - box.low[1], box.high[2] - box.low[2], 0.0});
  const double scale = side > 0.0 ? kAxisCells / side : 0.0;
  if (!std::isfinite(side) || !std::isfinite(scale)) {
    throw std::invalid_argument("cannot quantise positions that span " + std::to_string(side));
  }
  Sorted sorted(n);
  parallel_ranges(n, [&](size_t begin, size_t end) {
    for (size_t i = begin; i < end; ++i) {
      uint64_t key = 0;
      for (int k = 0; k < 3; ++k) {
        const double index = std::floor((static_cast<double>(p[3 * i + k]) - box.low[k]) * scale);
        key |= spread(static_cast<uint64_t>(std::min(index, kAxisCells - 1.0))) << k;
      }
      sorted.keys[i] = key;
    }
  });
  sort_keys(sorted.keys.get(), sorted.order.get(), n);
  parallel_ranges(n, [&](size_t begin, size_t end) {
    for (size_t i = begin; i < end; ++i) out[i] = sorted.order[i];
  });
}

template <class Scalar>
void bind_for(nb::module_& m) {
  m.def("cell_keys", &cell_keys<Scalar>, nb::arg("positions").noconvert(), nb::arg("cell_size"), nb::arg("origin"),
        nb::arg("keys"));
  m.def("group_max", &group_max<Scalar>, nb::arg("values").noconvert(), nb::arg("group"), nb::arg("result"));
  m.def("morton_order", &morton_order<Scalar>, nb::arg("positions").noconvert(), nb::arg("order"));
}

}  // namespace

VDGS_BIND(cells) {
  bind_for<float>(m);
  bind_for<double>(m);
  m.def("group_cells", &group_cells, nb::arg("keys"), nb::arg("unique"), nb::arg("group"));
  m.def("contains", &contains, nb::arg("table"), nb::arg("query"), nb::arg("result"));
}

}  // namespace vdgs
