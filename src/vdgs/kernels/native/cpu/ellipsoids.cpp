// The mean of ellipsoids: that of the logarithms of their covariances, by the weight of each. Eight Gaussians are lanes.
// What is computed, and why, is said in vdgs.kernels.torch_ref.ellipsoids.
#include <algorithm>
#include <cmath>
#include <cstdint>

#include "bindings.h"
#include "simd/simd.h"
#include "threads.h"

namespace vdgs {
namespace {

constexpr int kEight = 8;
constexpr int64_t kTaskGroups = 64;
constexpr int kSweeps = 5;

struct Pairs {
  const float *log_scales, *quaternions, *weights;
};

// Symmetric matrices, a lane each: the diagonal, then (1, 2), (2, 0), (0, 1), so that what is off the diagonal and in
// the turn about axis k is number 3 + k.
using Matrices = double[6][kEight];

// Adds weight · R diag(log scales) Rᵀ to the matrix of a lane.
void add_logarithm(const float* s, const float* q, double weight, int lane, Matrices& sum) {
  const double inverse = 1.0 / std::sqrt(double{q[0]} * q[0] + double{q[1]} * q[1] + double{q[2]} * q[2] + double{q[3]} * q[3]);
  const double w = q[0] * inverse, x = q[1] * inverse, y = q[2] * inverse, z = q[3] * inverse;
  const double r[3][3] = {{1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)},
                          {2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)},
                          {2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)}};
  const double l[3] = {weight * s[0], weight * s[1], weight * s[2]};
  const auto product = [&](int i, int j) { return l[0] * r[i][0] * r[j][0] + l[1] * r[i][1] * r[j][1] + l[2] * r[i][2] * r[j][2]; };
  for (int i = 0; i < 3; ++i) {
    sum[i][lane] += product(i, i);
    sum[3 + i][lane] += product((i + 1) % 3, (i + 2) % 3);
  }
}

// Turns the axes i and j, which follow each other, so that the element between them becomes 0, and the quaternion with
// them: the smaller of the two angles that do it, by the roots of its cosine and sine.
VDGS_INLINE void turn(int i, int j, Matrices& a, double (&q)[4][kEight]) {
  const int k = 3 - i - j;
  double *own = a[i], *other = a[j], *between = a[3 + k], *to_other = a[3 + i], *to_own = a[3 + j];
  for (int lane = 0; lane < kEight; ++lane) {
    const double apart = own[lane] - other[lane], aside = 2 * between[lane];
    const double length = std::sqrt(apart * apart + aside * aside);
    const double sure = length > 0 ? length : 1.0, twice = length > 0 ? std::abs(apart) / sure : 1.0;
    const double c = std::sqrt(0.5 * (1 + twice));
    const double s = (apart < 0 ? -0.5 : 0.5) * aside / (sure * c);
    const double turned = c * c * own[lane] + c * s * aside + s * s * other[lane];
    other[lane] = s * s * own[lane] - c * s * aside + c * c * other[lane];
    own[lane] = turned;
    between[lane] = 0.0;
    const double u = to_own[lane], v = to_other[lane];
    to_own[lane] = c * u + s * v;
    to_other[lane] = c * v - s * u;
    const double half_c = std::sqrt(0.5 * (1 + c)), half_s = 0.5 * s / half_c;
    // Times the quaternion (half_c, half_s along axis k).
    const double qw = q[0][lane], qk = q[1 + k][lane], qi = q[1 + i][lane], qj = q[1 + j][lane];
    q[0][lane] = qw * half_c - qk * half_s;
    q[1 + k][lane] = qk * half_c + qw * half_s;
    q[1 + i][lane] = qi * half_c + qj * half_s;
    q[1 + j][lane] = qj * half_c - qi * half_s;
  }
}

void mean(const Pairs& pairs, const int64_t* starts, int64_t first, int64_t lanes, int64_t m, int64_t p,
          float* log_scales, float* quaternions) {
  alignas(64) Matrices a = {};
  for (int lane = 0; lane < lanes; ++lane) {
    const int64_t own = first + lane, begin = starts[own], end = own + 1 < m ? starts[own + 1] : p;
    double total = 0.0;
    for (int64_t pair = begin; pair < end; ++pair) {
      total += pairs.weights[pair];
      add_logarithm(pairs.log_scales + 3 * pair, pairs.quaternions + 4 * pair, pairs.weights[pair], lane, a);
    }
    for (auto& element : a) element[lane] /= total;
  }
  alignas(64) double q[4][kEight] = {};
  for (double& w : q[0]) w = 1.0;
  for (int sweep = 0; sweep < kSweeps; ++sweep) {
    turn(0, 1, a, q);
    turn(1, 2, a, q);
    turn(2, 0, a, q);
  }
  for (int64_t lane = 0; lane < lanes; ++lane) {
    for (int i = 0; i < 3; ++i) log_scales[3 * (first + lane) + i] = static_cast<float>(a[i][lane]);
    for (int i = 0; i < 4; ++i) quaternions[4 * (first + lane) + i] = static_cast<float>(q[i][lane]);
  }
}

using Vector = Array<const float, nb::ndim<1>>;
using Matrix = Array<const float, nb::ndim<2>>;
using Found = Array<float, nb::ndim<2>>;

void bound(Matrix log_scales, Matrix quaternions, Vector weights, Array<const int64_t, nb::ndim<1>> starts,
           Found mean_log_scales, Found mean_quaternions) {
  nb::gil_scoped_release release;
  const Pairs pairs{log_scales.data(), quaternions.data(), weights.data()};
  const int64_t m = static_cast<int64_t>(starts.shape(0)), p = static_cast<int64_t>(weights.shape(0));
  constexpr int64_t task = kTaskGroups * kEight;
  parallel_for((m + task - 1) / task, [&](int64_t index) {
    const int64_t end = std::min(m, (index + 1) * task);
    for (int64_t first = index * task; first < end; first += kEight)
      mean(pairs, starts.data(), first, std::min<int64_t>(kEight, end - first), m, p, mean_log_scales.data(),
           mean_quaternions.data());
  });
}

}  // namespace

VDGS_BIND(ellipsoids) {
  m.def("mean_ellipsoids", &bound, nb::arg("log_scales"), nb::arg("quaternions"), nb::arg("weights"),
        nb::arg("starts"), nb::arg("mean_log_scales"), nb::arg("mean_quaternions"));
}

}  // namespace vdgs
