// Adam for rows: by itself, and within the derivative of decoding.
#pragma once

#include <algorithm>
#include <cstddef>
#include <cstdint>

namespace vdgs {

// parameter -= rate * m / (sqrt(v) * root + epsilon): both bias corrections are in rate and root, which depend on
// the number of updates that a row has had, this one included.
struct AdamStep {
  const float *rates, *roots;  // for 1, 2, ... updates; the last one for all that are more
  int64_t length;
  double beta1, beta2, epsilon;
  int64_t entry(int32_t updates) const { return std::min<int64_t>(updates, length) - 1; }
};

// A parameter with its moments, rows of `width` floats each, and the step that they are to make.
struct AdamRows {
  float *parameter, *first, *second;
  size_t width;
  AdamStep step;
};

bool all_finite(const float* values, size_t size);

// Moves the `count` rows of `state` that `rows` names, or the first ones (null). The gradient holds `count`
// packed rows, `updates` for each of them which update it is, from 1 (null: 1 for all, and so the first entry of the
// step). Every number is computed alike, however the rows are shared out among calls.
void adam_update(const AdamRows& state, const int64_t* rows, size_t count, const float* gradient,
                 const int32_t* updates);

}  // namespace vdgs
