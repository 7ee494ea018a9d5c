// A step of Adam for whole small tensors: vdgs.kernels.torch_ref.adam_tensors on a GPU.
//
// A block of threads a tensor: it looks at all gradients first, and moves nothing where one of them is not finite.

namespace {

constexpr int kThreads = 256;
constexpr int kTensors = 32;  // of one launch: MAX_TENSORS in adam.py

struct Tensors {
  float* parameter[kTensors];
  float* first[kTensors];
  float* second[kTensors];
  const float* gradient[kTensors];
  int size[kTensors];
  float rate[kTensors];
};

__device__ bool is_finite(float a) { return fabsf(a) <= 3.402823466e38f; }

}  // namespace

// parameter -= rate m / (sqrt(v) root + epsilon); `fresh`: 1 - beta, of which a float's difference would be 1e-5 off;
// `finite` [tensors].
extern "C" __global__ void __launch_bounds__(kThreads)
adam_tensors(const Tensors tensors, float root, float beta1, float beta2, float fresh1, float fresh2,
             float epsilon, bool* finite) {
  const int which = blockIdx.x, size = tensors.size[which];
  const float* gradient = tensors.gradient[which];
  bool mine = true;
  for (int i = threadIdx.x; i < size; i += kThreads) mine = mine && is_finite(gradient[i]);
  const bool all = __syncthreads_and(mine);
  if (threadIdx.x == 0) finite[which] = all;
  if (!all) return;
  float *parameter = tensors.parameter[which], *first = tensors.first[which], *second = tensors.second[which];
  for (int i = threadIdx.x; i < size; i += kThreads) {
    const float g = gradient[i];
    first[i] = beta1 * first[i] + fresh1 * g;
    second[i] = beta2 * second[i] + fresh2 * (g * g);
    parameter[i] -= tensors.rate[which] * first[i] / (sqrtf(second[i]) * root + epsilon);
  }
}
