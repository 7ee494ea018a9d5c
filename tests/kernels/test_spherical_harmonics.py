"""Spherical harmonics of 3DGS: orthonormal, with their known values and gradients."""

import math

import numpy as np
import pytest
import torch

from vdgs.kernels.spherical_harmonics import eval_sh_bases, eval_sh_colors, num_sh_bases, rgb_to_sh


def quadrature() -> tuple[torch.Tensor, torch.Tensor]:
    """Unit directions and weights that integrate polynomials up to degree 6 over the sphere exactly."""
    z, weights = np.polynomial.legendre.leggauss(8)
    angle = np.arange(16) * 2 * np.pi / 16
    ring = np.sqrt(1 - z**2)
    directions = np.stack(
        [ring[:, None] * np.cos(angle), ring[:, None] * np.sin(angle), np.repeat(z[:, None], 16, 1)], -1
    )
    return torch.from_numpy(directions.reshape(-1, 3)), torch.from_numpy(np.repeat(weights * 2 * np.pi / 16, 16))


@pytest.mark.parametrize("degree", [0, 1, 2, 3])
def test_the_functions_are_orthonormal(degree):
    directions, weights = quadrature()
    values = eval_sh_bases(directions, degree)
    torch.testing.assert_close((values * weights[:, None]).T @ values, torch.eye(num_sh_bases(degree)).double())


def test_the_functions_have_their_known_values():
    x, y, z = torch.eye(3, dtype=torch.float64)
    diagonal = (x + y) / math.sqrt(2)
    values = eval_sh_bases(torch.stack([x, y, z, diagonal]), 3)
    torch.testing.assert_close(values[:, 0], torch.full((4,), 0.28209479177387814).double())
    # (1,-1), (1,0), (1,1) look along -y, z, -x.
    torch.testing.assert_close(values[0, 1:4], -0.4886025119029199 * x.flip(0))
    torch.testing.assert_close(values[1, 1:4], torch.tensor([-0.4886025119029199, 0, 0]).double())
    torch.testing.assert_close(values[2, 1:4], torch.tensor([0, 0.4886025119029199, 0]).double())
    assert float(values[3, 4]) == pytest.approx(1.0925484305920792 / 2)  # xy
    assert float(values[2, 6]) == pytest.approx(0.31539156525252005 * 2)  # 3 z² - 1
    assert float(values[0, 9]) == pytest.approx(0)
    assert float(values[1, 9]) == pytest.approx(0.5900435899266435)  # y³, from -y (3 x² - y²)
    assert float(values[2, 12]) == pytest.approx(0.3731763325901154 * 2)  # z (5 z² - 3)
    assert float(values[0, 15]) == pytest.approx(-0.5900435899266435)  # -x³


def test_a_parity_belongs_to_each_band():
    directions, _ = quadrature()
    there, back = eval_sh_bases(directions, 3), eval_sh_bases(-directions, 3)
    for band in range(4):
        part = slice(band**2, (band + 1) ** 2)
        torch.testing.assert_close(back[:, part], (-1) ** band * there[:, part])


def test_colors_follow_the_viewing_direction():
    dc = rgb_to_sh(torch.tensor([[0.2, 0.5, 0.9]]))
    rest = torch.zeros(1, 15, 3)
    right = torch.tensor([[1.0, 0, 0]])
    torch.testing.assert_close(eval_sh_colors(dc, rest, right, 3), torch.tensor([[0.2, 0.5, 0.9]]))
    rest[0, 2, 0] = -1.0  # grows with x
    assert eval_sh_colors(dc, rest, right, 1)[0, 0] > 0.5 > eval_sh_colors(dc, rest, -right, 1)[0, 0]
    assert float(eval_sh_colors(dc, rest, -right, 1)[0, 0]) == 0.0  # not below black
    torch.testing.assert_close(eval_sh_colors(dc, rest, -right, 0), torch.tensor([[0.2, 0.5, 0.9]]))
    with pytest.raises(ValueError, match="further coefficients"):
        eval_sh_colors(dc, rest[:, :3], right, 2)
    with pytest.raises(ValueError, match="degree"):
        eval_sh_bases(right, 4)


@pytest.mark.parametrize("degree", [0, 1, 2, 3])
def test_colors_have_the_gradients_of_finite_differences(degree):
    generator = torch.Generator().manual_seed(degree)

    def draw(*shape: int) -> torch.Tensor:
        return (0.1 * torch.randn(*shape, generator=generator, dtype=torch.float64)).requires_grad_()

    dc, rest, towards = draw(5, 3), draw(5, num_sh_bases(degree) - 1, 3), draw(5, 3)

    def colors(dc, rest, towards):
        return eval_sh_colors(dc, rest, torch.nn.functional.normalize(towards, dim=-1), degree)

    assert torch.autograd.gradcheck(colors, (dc, rest, towards))
