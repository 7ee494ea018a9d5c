// Which points cameras see: vdgs.kernels.torch_ref.visibility on a GPU. A thread a point; float64 decides.

namespace {

constexpr int kThreads = 256;
constexpr int kNumbers = 20;

// `Camera.packed_float64`: rotation (9), translation (3), fx, fy, cx, cy, width, height, orthographic, near.
struct Frustum {
  double of[kNumbers];
};

struct Point {
  double x, y, z;
};

__device__ Point read_point(const float* points, long long i) {
  return {points[3 * i], points[3 * i + 1], points[3 * i + 2]};
}

__device__ bool is_finite(double a) { return fabs(a) <= 1.7976931348623157e308; }

__device__ bool holds(const double* f, const Point& p) {
  if (!(is_finite(p.x) && is_finite(p.y) && is_finite(p.z))) return false;
  const double x = f[0] * p.x + f[1] * p.y + f[2] * p.z + f[9], y = f[3] * p.x + f[4] * p.y + f[5] * p.z + f[10];
  const double z = f[6] * p.x + f[7] * p.y + f[8] * p.z + f[11];
  if (!(z > f[19])) return false;
  const double divisor = f[18] != 0.0 ? 1.0 : z;
  const double column = f[12] * x / divisor + f[14], row = f[13] * y / divisor + f[15];
  return column >= 0.0 && column < f[16] && row >= 0.0 && row < f[17];
}

}  // namespace

// `seen` [n]: whether one camera sees a point.
extern "C" __global__ void __launch_bounds__(kThreads)
mark_visible(const float* points, long long count, const Frustum frustum, bool* seen) {
  const long long i = static_cast<long long>(blockIdx.x) * kThreads + threadIdx.x;
  if (i < count) seen[i] = holds(frustum.of, read_point(points, i));
}

// `frusta` [cameras, kNumbers]; `views` [n]: how many of them see a point.
extern "C" __global__ void __launch_bounds__(kThreads)
count_visibility(const float* points, long long count, const double* frusta, int cameras, int* views) {
  const long long i = static_cast<long long>(blockIdx.x) * kThreads + threadIdx.x;
  if (i >= count) return;
  const Point point = read_point(points, i);
  int found = 0;
  for (int camera = 0; camera < cameras; ++camera) found += holds(frusta + kNumbers * camera, point);
  views[i] = found;
}
