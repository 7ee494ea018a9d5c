// Constants of the image formation model, for every kernel. Explained, and repeated, in
// src/vdgs/kernels/constants.py; tests compare the two.
#pragma once

namespace vdgs {

constexpr float kAlphaMin = 1.0f / 255.0f;
constexpr float kLog2AlphaMin = -7.994353436858858f;
constexpr float kAlphaMax = 0.999f;
constexpr float kTransmittanceMin = 1e-4f;
constexpr float kMedianTransmittance = 0.5f;
constexpr float kDilationPx2 = 0.3f;
constexpr float kFrustumMargin = 1.3f;

}  // namespace vdgs
