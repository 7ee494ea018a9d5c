"""The typed set of numerical operations, with interchangeable implementations.

`reference` is readable torch (the oracle of the tests), `native` is C++ for the CPU. Both offer the
functions below under the same names; every one is differentiable through torch where it says so.

Names and dimensions, fixed once for all files in this folder:

    n  anchors of the model          v  anchors visible in the view
    k  offsets per anchor            m  splats: Gaussians that survive decoding (opacity > 0)
    h, w  image height and width in pixels

    cull(positions [n,3], log_scales [n,6], camera) -> int64 [v], ascending
    decode(positions [v,3], features [v,32], offsets [v,k,3], log_scales [v,6], decoder weights, camera) -> Splats
    project(means [m,3], scales [m,3], quaternions [m,4], camera) -> means_px, conics, depths
    rasterise(splats..., background [3], width, height) -> image [h,w,3], alpha [h,w], depth [h,w]
    photometric_loss(image [h,w,3], target uint8 [h,w,3], mask) -> loss, l1, ssim
    adam_rows(parameter [n,...], rows [v], gradient [v,...], moments, ...) in place
    count_views(points [n,3], cameras) -> int32 [n]

Constants shared by all implementations live in `constants.py`.
"""
