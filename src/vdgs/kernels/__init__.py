"""The typed set of numerical operations, with interchangeable implementations.

`reference` is readable torch (the oracle of the tests), `native` is C++ for the CPU. Both offer the
functions below under the same names; "d" marks those that torch can differentiate. `cuda` is for NVIDIA GPUs and has
some of them so far (`operations`).

Names and dimensions, fixed once for all files in this folder:

    n  anchors of the model          v  anchors visible in the view
    k  offsets per anchor            m  splats: Gaussians that survive decoding
    h, w  image height and width in pixels

       cull(positions [n,3], log_scales [n,6], camera) -> int64 [v], ascending
    d  decode(positions [n,3], features [n,32], offsets [n,k,3], log_scales [n,6], weights, camera,
              rows [v]) -> Splats
       decode_backward_adam(positions [n,3], moved, weights, camera, rows [v], splats, gradients, step)
                 -> finite, gradients of the weights; anchors move in place
    d  project(means [m,3], scales [m,3], quaternions [m,4], camera) -> Projected
    d  rasterise(means_px [m,2], conics [m,3], colours [m,3], opacities [m], depths [m],
                 background [3], width, height) -> Raster(image [h,w,3], alpha [h,w], depth [h,w])
    d  photometric_loss(image [h,w,3], target uint8 [h,w,3], mask) -> Photometric(loss, l1, ssim)
       adam_rows(parameter [n,...], rows [v], gradient [v,...], moments, ...) -> finite; in place
       add_view_statistics(visible [v], source [m], opacities [m], gradient_px [m,2], ..., sums) in place
       count_visibility(points [n,3], cameras) -> int32 [n];  mark_visible(points [n,3], camera) -> bool [n]
       cell_keys, cell_centres, group_cells, group_max, contains, morton_order: the lattice of growth

Constants shared by all implementations live in `constants.py`.
"""
