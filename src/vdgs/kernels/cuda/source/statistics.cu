// Growth's statistics of one view: vdgs.kernels.torch_ref.statistics on a GPU.
//
// A thread a splat, and a visible anchor. No source comes twice, and those of an anchor stand together, ascending: each
// splat has an offset of its own, and the first of an anchor adds the opacities of those behind it, in their order. Nobody
// else writes there: no atomics, the same bits every time.

namespace {

constexpr int kThreads = 256;

}  // namespace

// `sources` [m]: (place in `visible`) k + offset. `inside` [v]: whether an anchor counts as seen. Sums: `gradient` and
// `drawn` [n, k], `opacity` and `seen` [n].
extern "C" __global__ void __launch_bounds__(kThreads)
add_view(const long long* visible, const bool* inside, long long anchors, const int* sources, const float* opacities,
         const float* by_means_px, long long splats, int k, float half_width, float half_height, float* gradient,
         float* drawn, float* opacity, float* seen) {
  const long long i = static_cast<long long>(blockIdx.x) * kThreads + threadIdx.x;
  if (i < anchors && inside[i]) seen[visible[i]] += 1.0f;
  if (i >= splats) return;
  const int source = sources[i], place = source / k;
  const long long anchor = visible[place], slot = anchor * k + source % k;
  const float x = by_means_px[2 * i] * half_width, y = by_means_px[2 * i + 1] * half_height;
  gradient[slot] += sqrtf(x * x + y * y);
  drawn[slot] += 1.0f;
  if (i > 0 && sources[i - 1] / k == place) return;
  float sum = opacities[i];
  for (long long next = i + 1; next < splats && sources[next] / k == place; ++next) sum += opacities[next];
  opacity[anchor] += sum;
}
