// Adam on the rows of a parameter that a view has touched.
#pragma once

#include <cstddef>
#include <cstdint>

namespace vdgs {

// parameter -= rate * m / (sqrt(v) * root + epsilon): both bias corrections are in rate and root.
struct AdamStep {
  float rate, root, beta1, beta2, epsilon;
};

// Whether all `size` values are finite.
bool all_finite(const float* values, size_t size);

// One step on `count` rows of `width` floats. rows ascend without repetition, or null: row i is row i.
// gradient holds `count` packed rows; the other three are addressed by row.
void adam_rows(float* parameter, const int64_t* rows, size_t count, size_t width, const float* gradient, float* first,
               float* second, const AdamStep& step);

}  // namespace vdgs
