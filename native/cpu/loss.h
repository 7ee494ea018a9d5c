// Photometric loss of an image: L1 and SSIM with the gradient of both, in one pass.
#pragma once

#include <cstdint>

namespace vdgs {

struct Photometric {
  double loss, l1, ssim;
};

// image, gradient: [height, width, 3]; target: the same in bytes; mask: [height, width], zero = does not
// count, or null; gradient null = not wanted. The meaning is that of reference/loss.py.
Photometric photometric_loss(const float* image, const uint8_t* target, const uint8_t* mask, int height, int width,
                             float ssim_weight, float* gradient);

}  // namespace vdgs
