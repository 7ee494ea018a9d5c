"""Constants of the image formation model and the loss, shared by every implementation.

The former are repeated in kernels/shared/image_formation.h; a test holds the two against each other.
"""

#: A splat contributes to a pixel where its alpha is at least this.
ALPHA_MIN = 1.0 / 255.0
#: Alpha is clamped here, so that transmittance never reaches zero in one step.
ALPHA_MAX = 0.999
#: A pixel is finished before its transmittance would fall below this.
TRANSMITTANCE_MIN = 1e-4
#: The median depth of a pixel is that of the splat at which its transmittance falls below this.
MEDIAN_TRANSMITTANCE = 0.5
#: Added to the diagonal of every projected covariance, in square pixels.
DILATION_PX2 = 0.3
#: The Jacobian of the projection is taken no further out than this many half-angles of the frustum.
FRUSTUM_MARGIN = 1.3
#: Side of the Gaussian window of SSIM (Wang et al. 2004).
SSIM_WINDOW_PX = 11
