"""Logs, points, matrices and prose beside photographs are not named as poses of other programs."""

from __future__ import annotations

import pytest

from vdgs.captures.nested_captures import foreign_poses


@pytest.mark.parametrize(
    ("name", "text"),
    [
        ("grid.out", "3 4\n1 2 3\n4 5 6\n7 8 9\n1 2 3\n4 5 6\n"),
        ("xyz.out", "100 200\n" + 8 * "1.5 2.5 3.5\n"),
        ("zeros.out", "100 200\n" + 10 * "0 0 0\n"),
        ("transform.txt", "1 0 0 5\n0 1 0 6\n0 0 1 7\n"),
        ("calib.txt", "2000 0 1024 0\n0 2000 768 0\n0 0 1 0\n"),
        ("gcp.txt", "".join(f"{k} 50000{k}.1 520000{k}.2 412.3\n" for k in range(3))),
        ("rtk.txt", "".join(f"170000000{k}.1 47.1 8.1 412.3 0.01 0.01 0.02 1\n" for k in range(5))),
        ("float.txt", "".join(f"170000000{k}.1 47.1 8.1 412.3 0.01 0.01 0.02 2\n" for k in range(5))),
        ("normals.txt", "".join(f"{k}.0 2.0 3.0 4.0 0.1 0.2 0.3 0.4\n" for k in range(5))),
        ("falls.txt", "".join(f"{9 - k} 2.0 3.0 4.0 0 0 0.6 0.8\n" for k in range(5))),
        ("spectra.txt", "".join(f"{k} {' '.join(12 * ['0.25'])}\n" for k in range(400, 420))),
        ("poses.txt", "".join(f"{k} {' '.join(16 * ['0.25'])}\n" for k in range(400, 420))),
        ("bands.txt", "".join(f"{k} {' '.join(11 * ['0.25'])}\n" for k in range(400, 420))),
        ("readme.txt", "Angles are given as omega, phi, kappa in the delivered files.\nAll good.\n"),
        ("delivery.txt", "The columns are name, x, y, z, omega, phi, kappa.\nIn metres, gon, and so on.\n"),
        ("ppk.csv", "name,lat,lon,alt,omega,phi,kappa\na.jpg,47.1,8.1,410,0,0,90\n"),
        ("geo.txt", "EPSG:32632\n#name x y z omega phi kappa\na.jpg 500000.1 5200000.1 410 0 0 90\n"),
        ("angles.dat", "time omega phi kappa\n1 2 3 4\n"),
        ("imu.csv", "timestamp,gx,gy,gz,ax,ay,az,qw,qx,qy,qz\n1,2,3,4,5,6,7,1,0,0,0\n"),
        ("heading.csv", "image,x,y,z,qw,qx,qy,qz\n"),
    ],
)
def test_texts_that_only_look_like_poses_are_not_named(tmp_path, name, text):
    (tmp_path / name).write_text(text)
    assert foreign_poses(tmp_path) == []
