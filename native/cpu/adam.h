// Adam for rows: by itself, and within the derivative of decoding.
#pragma once

#include <cstddef>
#include <cstdint>

namespace vdgs {

// parameter -= rate * m / (sqrt(v) * root + epsilon): both bias corrections are in rate and root.
struct AdamStep {
  double rate, root, beta1, beta2, epsilon;
};

// A parameter with its moments, rows of `width` floats each, and the step that they are to make.
struct AdamRows {
  float *parameter, *first, *second;
  size_t width;
  AdamStep step;
};

bool all_finite(const float* values, size_t size);

// Moves the `count` rows of `state` that `rows` names, or the first ones (null). The gradient holds `count`
// packed rows. Every number is computed alike, however the rows are shared out among calls.
void adam_update(const AdamRows& state, const int64_t* rows, size_t count, const float* gradient);

}  // namespace vdgs
