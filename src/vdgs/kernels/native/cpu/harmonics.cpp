// Colors as spherical harmonics: what they show from a place, and their fit to what cameras saw. Sixteen Gaussians are
// lanes.
#include <algorithm>
#include <cmath>
#include <cstdint>

#include "bindings.h"
#include "cpu/sh_basis.h"
#include "threads.h"

namespace vdgs {
namespace {

constexpr int64_t kTaskGroups = 32;
// A pivot below this is one of no weight at all: what it would ask for stays 0.
constexpr double kLeastPivot = 1e-12;

// Where element (i, j), j <= i, of a symmetric matrix lies.
constexpr int packed(int i, int j) { return i * (i + 1) / 2 + j; }

// ------------------------------------------------------------------------------------------------ colors

struct Coefficients {
  const float* first;
  int64_t stride;  // floats from one Gaussian to the next
};

template <int degree>
void show(const float* means, const int64_t* rows, Coefficients all, const float* eye, int64_t count, float* colors) {
  constexpr int f = functions(degree);
  alignas(64) float own[3 * f][kLanes] = {}, there[3][kLanes] = {};
  for (int64_t lane = 0; lane < count; ++lane) {
    const float* from = all.first + rows[lane] * all.stride;
    for (int i = 0; i < 3 * f; ++i) own[i][lane] = from[i];
    for (int i = 0; i < 3; ++i) there[i][lane] = means[3 * lane + i] - eye[i];
  }
  const F16 x = load(there[0]), y = load(there[1]), z = load(there[2]);
  const F16 scale = rsqrt(max(x * x + y * y + z * z, splat(1e-24f)));
  F16 functions_there[f];
  basis<degree>(x * scale, y * scale, z * scale, functions_there);
  alignas(64) float shown[3][kLanes];
  for (int channel = 0; channel < 3; ++channel) {
    F16 sum = splat(0.5f);
    for (int i = 0; i < f; ++i) sum = fma(functions_there[i], load(own[3 * i + channel]), sum);
    store(shown[channel], max(sum, splat(0.0f)));
  }
  for (int64_t lane = 0; lane < count; ++lane)
    for (int channel = 0; channel < 3; ++channel) colors[3 * lane + channel] = shown[channel][lane];
}

// ---------------------------------------------------------------------------------------------------- fit

struct Pairs {
  const float *directions, *colors, *weights;
};

// The pairs of one group of Gaussians: where those of each lane begin and how many there are; lanes beyond have none.
struct Runs {
  int64_t begin[kLanes] = {}, count[kLanes] = {};
  int64_t most = 0;
};

// A direction, what was seen of the color - 1/2, and its share of the Gaussian's weight, for every lane.
struct Seen {
  alignas(64) float direction[3][kLanes] = {}, color[3][kLanes] = {}, share[kLanes] = {};
};

VDGS_INLINE void gather(const Pairs& pairs, const Runs& runs, const float* of_one, int64_t turn, Seen& seen) {
  for (int lane = 0; lane < kLanes; ++lane) {
    seen.share[lane] = 0.0f;
    if (turn >= runs.count[lane]) continue;
    const int64_t pair = runs.begin[lane] + turn;
    for (int i = 0; i < 3; ++i) {
      seen.direction[i][lane] = pairs.directions[3 * pair + i];
      seen.color[i][lane] = pairs.colors[3 * pair + i] - 0.5f;
    }
    seen.share[lane] = pairs.weights[pair] * of_one[lane];
  }
}

// The ridge regression of sixteen Gaussians: normal equations, then Cholesky's factors in the matrix' place. In double
// precision, for where cameras look from few directions nothing but the ridge stands against what rounding leaves.
template <int degree>
class Regression {
 public:
  void add(const Seen& seen) {
    F16 at[f];
    basis<degree>(load(seen.direction[0]), load(seen.direction[1]), load(seen.direction[2]), at);
    alignas(64) float there[f][kLanes];
    for (int i = 0; i < f; ++i) store(there[i], at[i]);
    for (int i = 0; i < f; ++i) {
      alignas(64) Lanes weighted;
      for (int lane = 0; lane < kLanes; ++lane) weighted[lane] = double{seen.share[lane]} * there[i][lane];
      for (int j = 0; j <= i; ++j) add_product(matrix_[packed(i, j)], weighted, there[j]);
      for (int c = 0; c < 3; ++c) add_product(right_[3 * i + c], weighted, seen.color[c]);
    }
  }

  void solve(double ridge) {
    for (int i = 0; i < f; ++i) factorise(i, i == 0 ? 0.0 : ridge);
    for (int c = 0; c < 3; ++c) {
      for (int i = 0; i < f; ++i) {
        for (int j = 0; j < i; ++j) subtract_product(right_[3 * i + c], matrix_[packed(i, j)], right_[3 * j + c]);
        scale(right_[3 * i + c], inverse_[i]);
      }
      for (int i = f - 1; i >= 0; --i) {
        for (int j = i + 1; j < f; ++j) subtract_product(right_[3 * i + c], matrix_[packed(j, i)], right_[3 * j + c]);
        scale(right_[3 * i + c], inverse_[i]);
      }
    }
  }

  float solution(int i, int lane) const { return static_cast<float>(right_[i][lane]); }

 private:
  using Lanes = double[kLanes];
  static constexpr int f = functions(degree);

  static VDGS_INLINE void add_product(Lanes& sum, const Lanes& a, const float* b) {
    for (int lane = 0; lane < kLanes; ++lane) sum[lane] += a[lane] * b[lane];
  }
  static VDGS_INLINE void subtract_product(Lanes& sum, const Lanes& a, const Lanes& b) {
    for (int lane = 0; lane < kLanes; ++lane) sum[lane] -= a[lane] * b[lane];
  }
  static VDGS_INLINE void scale(Lanes& values, const Lanes& factor) {
    for (int lane = 0; lane < kLanes; ++lane) values[lane] *= factor[lane];
  }

  // Row i of the lower factor; the reciprocal of its diagonal apart.
  void factorise(int i, double ridge) {
    for (int j = 0; j < i; ++j) {
      for (int k = 0; k < j; ++k) subtract_product(matrix_[packed(i, j)], matrix_[packed(i, k)], matrix_[packed(j, k)]);
      scale(matrix_[packed(i, j)], inverse_[j]);
    }
    for (int j = 0; j < i; ++j) subtract_product(matrix_[packed(i, i)], matrix_[packed(i, j)], matrix_[packed(i, j)]);
    for (int lane = 0; lane < kLanes; ++lane) {
      const double pivot = matrix_[packed(i, i)][lane] + ridge;
      inverse_[i][lane] = pivot > kLeastPivot ? 1.0 / std::sqrt(pivot) : 0.0;
    }
  }

  alignas(64) Lanes matrix_[packed(f, 0)] = {}, right_[3 * f] = {}, inverse_[f] = {};
};

Runs runs_of(const int64_t* starts, int64_t first, int64_t m, int64_t p) {
  Runs runs;
  for (int64_t lane = 0; lane < std::min<int64_t>(kLanes, m - first); ++lane) {
    const int64_t own = first + lane;
    runs.begin[lane] = starts[own];
    runs.count[lane] = (own + 1 < m ? starts[own + 1] : p) - starts[own];
    runs.most = std::max(runs.most, runs.count[lane]);
  }
  return runs;
}

template <int degree>
void fit(const Pairs& pairs, const Runs& runs, double ridge, int64_t lanes, float* found) {
  float of_one[kLanes];
  for (int lane = 0; lane < kLanes; ++lane) {
    double total = 0.0;
    for (int64_t turn = 0; turn < runs.count[lane]; ++turn) total += pairs.weights[runs.begin[lane] + turn];
    of_one[lane] = total > 0.0 ? static_cast<float>(1.0 / total) : 0.0f;
  }
  Regression<degree> regression;
  Seen seen;
  for (int64_t turn = 0; turn < runs.most; ++turn) {
    gather(pairs, runs, of_one, turn, seen);
    regression.add(seen);
  }
  regression.solve(ridge);
  constexpr int width = 3 * functions(degree);
  for (int64_t lane = 0; lane < lanes; ++lane)
    for (int i = 0; i < width; ++i) found[lane * width + i] = regression.solution(i, static_cast<int>(lane));
}

// Calls body(group's first Gaussian, how many it has) for all groups of sixteen.
template <class Body>
void in_groups(int64_t m, const Body& body) {
  constexpr int64_t task = kTaskGroups * kLanes;
  parallel_for((m + task - 1) / task, [&](int64_t index) {
    const int64_t end = std::min(m, (index + 1) * task);
    for (int64_t first = index * task; first < end; first += kLanes)
      body(first, std::min<int64_t>(kLanes, end - first));
  });
}

using Vector = Array<const float, nb::ndim<1>>;
using Matrix = Array<const float, nb::ndim<2>>;
using Numbers = Array<const int64_t, nb::ndim<1>>;
// Rows may stand apart from each other.
using Rows = nb::ndarray<const float, nb::ndim<2>, nb::device::cpu>;

void bound_fit(Matrix directions, Matrix colors, Vector weights, Numbers starts, int degree, double ridge,
               Array<float, nb::ndim<2>> found) {
  nb::gil_scoped_release release;
  const Pairs pairs{directions.data(), colors.data(), weights.data()};
  const int64_t m = static_cast<int64_t>(starts.shape(0)), p = static_cast<int64_t>(weights.shape(0));
  with_degree(degree, [&](auto of) {
    in_groups(m, [&](int64_t first, int64_t lanes) {
      const Runs runs = runs_of(starts.data(), first, m, p);
      fit<decltype(of)::value>(pairs, runs, ridge, lanes, found.data() + first * 3 * functions(decltype(of)::value));
    });
  });
}

void bound_show(Matrix means, Rows coefficients, Numbers rows, Vector eye, int degree,
                Array<float, nb::ndim<2>> colors) {
  nb::gil_scoped_release release;
  const Coefficients all{coefficients.data(), coefficients.stride(0)};
  with_degree(degree, [&](auto of) {
    in_groups(static_cast<int64_t>(rows.shape(0)), [&](int64_t first, int64_t lanes) {
      show<decltype(of)::value>(means.data() + 3 * first, rows.data() + first, all, eye.data(), lanes,
                                colors.data() + 3 * first);
    });
  });
}

}  // namespace

VDGS_BIND(harmonics) {
  m.def("fit_harmonics", &bound_fit, nb::arg("directions"), nb::arg("colors"), nb::arg("weights"), nb::arg("starts"),
        nb::arg("degree"), nb::arg("ridge"), nb::arg("found"));
  m.def("harmonic_colors", &bound_show, nb::arg("means"), nb::arg("coefficients"), nb::arg("rows"), nb::arg("eye"),
        nb::arg("degree"), nb::arg("colors"));
}

}  // namespace vdgs
