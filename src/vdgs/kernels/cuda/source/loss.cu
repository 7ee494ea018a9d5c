// L1 and SSIM with their gradient on a GPU. Definition: torch_ref/loss.py; derivatives: native/cpu/loss.cpp.
//
// Three kernels. A block of 16x16 threads does one tile of the image, channel after channel: it reads the tile with a
// margin of half a window into shared memory, blurs it along the rows and then, one pixel a thread, down the columns.
//
//   photometric_forward   moments a = Gx, b = Gy, q = G(x^2 + y^2), c = G(xy); the tile's sums of |x - y| and 1 - S;
//                         where a gradient is asked for, the derivatives S_a, S_q, S_c of each pixel -> slopes
//   photometric_backward  G(S_a) + 2x G(S_q) + y G(S_c), with the sign of x - y: the gradient of the loss
//   photometric_total     adds the tiles' sums, always in the same order: the same bits every time
//
// Outside the image all is zero, so G is its own adjoint. Where the mask is zero x is replaced by y and nothing counts.
// Nothing here is special to a card: the tests run this text on the processor too.

namespace {

constexpr int kTile = 16;
constexpr int kHalf = 5;
constexpr int kTaps = 2 * kHalf + 1;
constexpr int kSpan = kTile + 2 * kHalf;  // of the tile with its margin
constexpr int kThreads = kTile * kTile;
constexpr int kMoments = 4;
constexpr int kSlopes = 3;
constexpr float kC1 = 0.01f * 0.01f;
constexpr float kC2 = 0.03f * 0.03f;

// A Gaussian of standard deviation 1.5 pixels with sum 1; a test compares it with torch_ref.loss.gaussian_window().
__constant__ const float kWindow[kTaps] = {
    0.00102838012f, 0.00759875821f, 0.0360007733f, 0.109360687f, 0.213005543f, 0.266011715f,
    0.213005543f, 0.109360687f, 0.0360007733f, 0.00759875821f, 0.00102838012f};

using Plane = float[kSpan][kSpan];
using Rows = float[kSpan][kTile];

struct Picture {
  const float* image;           // [height, width, 3]
  const unsigned char* target;  // [height, width, 3]
  const unsigned char* mask;    // [height, width], or null: every pixel counts
  int height, width;

  __device__ bool inside(int row, int column) const {
    return row >= 0 && row < height && column >= 0 && column < width;
  }
  __device__ long long pixel(int row, int column) const { return static_cast<long long>(row) * width + column; }
  __device__ bool counts(int row, int column) const { return !mask || mask[pixel(row, column)] != 0; }
  __device__ float goal(int row, int column, int channel) const {
    return static_cast<float>(target[3 * pixel(row, column) + channel]) / 255.0f;
  }
};

// The thread's place in its block, and the first row and column of the block's tile.
__device__ int thread() { return threadIdx.y * kTile + threadIdx.x; }
__device__ int tile_row() { return blockIdx.y * kTile; }
__device__ int tile_column() { return blockIdx.x * kTile; }

// Image and target of the tile and its margin, one channel.
__device__ void read_tile(const Picture& picture, int channel, Plane& x, Plane& y) {
  for (int i = thread(); i < kSpan * kSpan; i += kThreads) {
    const int row = tile_row() + i / kSpan - kHalf, column = tile_column() + i % kSpan - kHalf;
    float drawn = 0.0f, goal = 0.0f;
    if (picture.inside(row, column)) {
      goal = picture.goal(row, column, channel);
      drawn = picture.counts(row, column) ? picture.image[3 * picture.pixel(row, column) + channel] : goal;
    }
    x[i / kSpan][i % kSpan] = drawn;
    y[i / kSpan][i % kSpan] = goal;
  }
}

__device__ void blur_moments_along(const Plane& x, const Plane& y, Rows (&moments)[kMoments]) {
  for (int i = thread(); i < kSpan * kTile; i += kThreads) {
    const int row = i / kTile, column = i % kTile;
    float a = 0.0f, b = 0.0f, squares = 0.0f, products = 0.0f;
    for (int k = 0; k < kTaps; ++k) {
      const float weight = kWindow[k], u = x[row][column + k], v = y[row][column + k];
      a += weight * u;
      b += weight * v;
      squares += weight * (u * u + v * v);
      products += weight * (u * v);
    }
    moments[0][row][column] = a;
    moments[1][row][column] = b;
    moments[2][row][column] = squares;
    moments[3][row][column] = products;
  }
}

// Down the column of the thread's own pixel.
__device__ float blur_down(const Rows& rows) {
  float sum = 0.0f;
  for (int k = 0; k < kTaps; ++k) sum += kWindow[k] * rows[threadIdx.y + k][threadIdx.x];
  return sum;
}

struct Similarity {
  float value, by_mean, by_squares, by_products;  // S and its derivatives by a, q and c
};

__device__ Similarity similarity(float a, float b, float squares, float products) {
  const float means = a * a + b * b;
  const float a1 = 2.0f * a * b + kC1, a2 = 2.0f * (products - a * b) + kC2;
  const float b1 = means + kC1, b2 = squares - means + kC2;
  const float inverse = 1.0f / (b1 * b2), s = a1 * a2 * inverse;
  return {s, 2.0f * (b * (a2 - a1) - a * s * (b2 - b1)) * inverse, -s * b1 * inverse, 2.0f * a1 * inverse};
}

// Sum over the block, for thread 0; the others get zero. All threads take part.
__device__ double add_up(double value, double (&room)[kThreads]) {
  room[thread()] = value;
  for (int half = kThreads / 2; half > 0; half /= 2) {
    __syncthreads();
    if (thread() < half) room[thread()] += room[thread() + half];
  }
  __syncthreads();  // before the room is used again
  return thread() == 0 ? room[0] : 0.0;
}

__device__ float weight_of_a_value(const long long* kept) {
  // With nothing kept both sums are zero, whatever they are divided by.
  return 1.0f / (3.0f * static_cast<float>(*kept > 0 ? *kept : 1));
}

}  // namespace

// Grid: one block a tile. `slopes` [3, height, width, 3] or null; `sums` [tiles, 2]: of |x - y| and of 1 - S.
extern "C" __global__ void __launch_bounds__(kThreads)
photometric_forward(const float* image, const unsigned char* target, const unsigned char* mask, int height, int width,
                    float* slopes, double* sums) {
  __shared__ Plane x, y;
  __shared__ Rows moments[kMoments];
  __shared__ double room[kThreads];
  const Picture picture{image, target, mask, height, width};
  const int row = tile_row() + threadIdx.y, column = tile_column() + threadIdx.x;
  const bool counts = picture.inside(row, column) && picture.counts(row, column);
  float l1 = 0.0f, dissimilarity = 0.0f;
  for (int channel = 0; channel < 3; ++channel) {
    read_tile(picture, channel, x, y);
    __syncthreads();
    blur_moments_along(x, y, moments);
    __syncthreads();
    const Similarity s =
        similarity(blur_down(moments[0]), blur_down(moments[1]), blur_down(moments[2]), blur_down(moments[3]));
    if (counts) {
      l1 += fabsf(x[threadIdx.y + kHalf][threadIdx.x + kHalf] - y[threadIdx.y + kHalf][threadIdx.x + kHalf]);
      dissimilarity += 1.0f - s.value;
    }
    if (slopes && picture.inside(row, column)) {
      const long long plane = 3LL * height * width, at = 3 * picture.pixel(row, column) + channel;
      slopes[at] = counts ? s.by_mean : 0.0f;
      slopes[at + plane] = counts ? s.by_squares : 0.0f;
      slopes[at + 2 * plane] = counts ? s.by_products : 0.0f;
    }
    __syncthreads();  // before x and y are read anew
  }
  const double all_l1 = add_up(l1, room), all_dissimilarity = add_up(dissimilarity, room);
  if (thread() == 0) {
    double* sum = sums + 2LL * (blockIdx.y * gridDim.x + blockIdx.x);
    sum[0] = all_l1;
    sum[1] = all_dissimilarity;
  }
}

// Grid: one block a tile. `kept` [1]: how many pixels count. `gradient` [height, width, 3] is written whole.
extern "C" __global__ void __launch_bounds__(kThreads)
photometric_backward(const float* image, const unsigned char* target, const unsigned char* mask, int height, int width,
                     const float* slopes, const long long* kept, float ssim_weight, float* gradient) {
  __shared__ Plane tile[kSlopes];
  __shared__ Rows rows[kSlopes];
  const Picture picture{image, target, mask, height, width};
  const int row = tile_row() + threadIdx.y, column = tile_column() + threadIdx.x;
  const float weight = weight_of_a_value(kept);
  const long long plane = 3LL * height * width;
  for (int channel = 0; channel < 3; ++channel) {
    for (int i = thread(); i < kSpan * kSpan; i += kThreads) {
      const int r = tile_row() + i / kSpan - kHalf, c = tile_column() + i % kSpan - kHalf;
      const bool inside = picture.inside(r, c);
      for (int slope = 0; slope < kSlopes; ++slope) {
        tile[slope][i / kSpan][i % kSpan] = inside ? slopes[slope * plane + 3 * picture.pixel(r, c) + channel] : 0.0f;
      }
    }
    __syncthreads();
    for (int i = thread(); i < kSpan * kTile; i += kThreads) {
      for (int slope = 0; slope < kSlopes; ++slope) {
        float sum = 0.0f;
        for (int k = 0; k < kTaps; ++k) sum += kWindow[k] * tile[slope][i / kTile][i % kTile + k];
        rows[slope][i / kTile][i % kTile] = sum;
      }
    }
    __syncthreads();
    if (picture.inside(row, column)) {
      const long long at = 3 * picture.pixel(row, column) + channel;
      float total = 0.0f;
      if (picture.counts(row, column)) {
        const float u = image[at], v = picture.goal(row, column, channel);
        const float ssim = blur_down(rows[0]) + 2.0f * u * blur_down(rows[1]) + v * blur_down(rows[2]);
        const float sign = u > v ? 1.0f : u < v ? -1.0f : 0.0f;
        total = weight * ((1.0f - ssim_weight) * sign - ssim_weight * ssim);
      }
      gradient[at] = total;
    }
  }
}

// One block. Writes three numbers.
extern "C" __global__ void __launch_bounds__(kThreads)
photometric_total(const double* sums, int tiles, const long long* kept, float ssim_weight, float* loss, float* l1_mean,
                  float* ssim) {
  __shared__ double room[kThreads];
  double l1 = 0.0, dissimilarity = 0.0;
  for (int tile = thread(); tile < tiles; tile += kThreads) {
    l1 += sums[2LL * tile];
    dissimilarity += sums[2LL * tile + 1];
  }
  const double all_l1 = add_up(l1, room), all_dissimilarity = add_up(dissimilarity, room);
  if (thread() == 0) {
    const double count = 3.0 * static_cast<double>(*kept > 0 ? *kept : 1);
    const double mean_l1 = all_l1 / count, mean = all_dissimilarity / count;
    *loss = static_cast<float>((1.0 - ssim_weight) * mean_l1 + ssim_weight * mean);
    *l1_mean = static_cast<float>(mean_l1);
    *ssim = static_cast<float>(1.0 - mean);
  }
}
