"""A known flight in the files of other programs, each after the program's own description."""

from __future__ import annotations

import json
import math
import struct
from pathlib import Path
from typing import Any

import numpy as np

from support.known_flight import ORIGIN, KnownFlight
from vdgs.geometry.crs import open_crs, utm_epsg
from vdgs.geometry.geodesy import geodetic_from_enu


def rotation_vector(rotation: np.ndarray) -> list[float]:
    """The axis of a rotation times its angle in radians."""
    from scipy.spatial.transform import Rotation

    return Rotation.from_matrix(rotation).as_rotvec().tolist()


def opensfm_camera(flight: KnownFlight) -> dict[str, Any]:
    lens, (width, height), longer = flight.lens, flight.lens.size, max(flight.lens.size)
    k1, k2, k3, _ = lens.k
    return {
        "projection_type": "brown", "width": width, "height": height,
        "focal_x": lens.focal / longer, "focal_y": lens.focal * lens.aspect / longer,
        "c_x": (lens.center[0] - width / 2) / longer, "c_y": (lens.center[1] - height / 2) / longer,
        "k1": k1, "k2": k2, "k3": k3, "p1": lens.p[0], "p2": lens.p[1],
    }  # fmt: skip


def opensfm_reconstruction(flight: KnownFlight, names: list[str] | None = None) -> dict[str, Any]:
    """A reconstruction as OpenSfM's io.py writes it."""
    camera = "v2 dji fc6310r 800 600 brown 0.6666"
    shots = {
        name: {"rotation": rotation_vector(pose[:3, :3]), "translation": pose[:3, 3].tolist(), "camera": camera,
               "orientation": 1, "capture_time": 0.0, "gps_dop": 5.0, "scale": 1.0, "covariance": [], "merge_cc": 0}
        for name, pose in zip(flight.names, flight.poses, strict=True) if names is None or name in names
    }  # fmt: skip
    points = {
        str(k): {"color": [float(c) for c in color], "coordinates": point.tolist()}
        for k, (point, color) in enumerate(zip(flight.points, flight.colors, strict=True))
    }
    return {"cameras": {camera: opensfm_camera(flight)}, "shots": shots, "points": points}


def write_opensfm(folder: Path, flight: KnownFlight) -> Path:
    folder.mkdir(parents=True, exist_ok=True)
    (folder / "reconstruction.json").write_text(json.dumps([opensfm_reconstruction(flight)]))
    (folder / "reference_lla.json").write_text(
        json.dumps(dict(zip(("latitude", "longitude", "altitude"), ORIGIN, strict=True)))
    )
    write_tracks(folder / "tracks.csv", flight)
    return folder / "reconstruction.json"


def write_tracks(file: Path, flight: KnownFlight) -> None:
    """Which photograph shows which point, and where: shares of the longer side from the middle."""
    size, lines = np.array(flight.lens.size), ["OPENSFM_TRACKS_VERSION_v2"]
    for index, name in enumerate(flight.names):
        pixels = flight.pixels(index)
        for k in np.flatnonzero(flight.shows(index)):
            x, y = ((pixels[k] - size / 2) / size.max()).tolist()
            lines.append(f"{name}\t{k}\t{k}\t{x!r}\t{y!r}\t0.004\t9\t9\t9\t-1\t-1")
    file.write_text("\n".join(lines) + "\n")


def utm_flight(flight: KnownFlight, unit: float = 1.0) -> tuple[str, np.ndarray, np.ndarray, np.ndarray]:
    """The zone of UTM; poses and points of the flight in it, x, y and z in a unit of so many metres. Cameras turn with
    the grid where they are."""
    import pyproj

    code = utm_epsg(*ORIGIN[:2])
    crs = open_crs(code, ORIGIN)

    def to_utm(enu: np.ndarray) -> np.ndarray:
        return crs.from_geodetic(geodetic_from_enu(enu, ORIGIN)) / unit

    poses = []
    for pose, center in zip(flight.poses, flight.centers, strict=True):
        ends = [to_utm((center + step)[None])[0] - to_utm((center - step)[None])[0] for step in 5 * np.eye(3)]
        slope = np.stack(ends, axis=1)
        left, _, right = np.linalg.svd(slope / np.linalg.norm(slope, axis=0))
        moved = np.eye(4)
        moved[:3, :3] = pose[:3, :3] @ (left @ right).T
        moved[:3, 3] = -moved[:3, :3] @ to_utm(center[None])[0]
        poses.append(moved)
    if unit != 1:
        code = pyproj.CRS(f"+proj=utm +zone={code[-2:]} +south +datum=WGS84 +to_meter={unit}").to_wkt("WKT1_ESRI")
    return code, np.array(poses), to_utm(flight.points), np.array([to_utm(each[None])[0] for each in flight.centers])


def write_odm_report(project: Path, flight: KnownFlight) -> Path:
    """odm_report/shots.geojson and cameras.json as ODM writes them: the translation is the place of the camera."""
    _, poses, _, centers = utm_flight(flight)
    width, height = flight.lens.size
    geodetic = geodetic_from_enu(flight.centers, ORIGIN)
    features = [
        {"type": "Feature",
         "properties": {"filename": name, "focal": flight.lens.focal / max(flight.lens.size), "width": width,
                        "height": height, "translation": center.tolist(),
                        "rotation": rotation_vector(pose[:3, :3])},
         "geometry": {"type": "Point", "coordinates": [lon, lat, up]}}
        for name, pose, center, (lat, lon, up) in zip(flight.names, poses, centers, geodetic, strict=True)
    ]  # fmt: skip
    (project / "odm_report").mkdir(parents=True, exist_ok=True)
    (project / "cameras.json").write_text(json.dumps({"v2 dji fc6310r": opensfm_camera(flight)}))
    file = project / "odm_report" / "shots.geojson"
    file.write_text(json.dumps({"type": "FeatureCollection", "features": features}))
    return file


def write_bundler(folder: Path, flight: KnownFlight, header: str = "# Bundle file v0.3") -> Path:
    """bundle.out and list.txt as Bundler's manual has them; of the lens only focal length, k1 and k2."""
    folder.mkdir(parents=True, exist_ok=True)
    turn = np.diag([1.0, -1.0, -1.0])
    lens, lines = flight.lens, [header, f"{len(flight.names)} {len(flight.points)}"]
    for pose in flight.poses:
        lines.append(f"{lens.focal!r} {lens.k[0]!r} {lens.k[1]!r}")
        lines += [" ".join(map(repr, row.tolist())) for row in (*(turn @ pose[:3, :3]), turn @ pose[:3, 3])]
    pixels = [flight.pixels(k) for k in range(len(flight.names))]
    shown = [flight.shows(k) for k in range(len(flight.names))]
    half = np.array(lens.size) / 2
    for k, (point, color) in enumerate(zip(flight.points, flight.colors, strict=True)):
        seen = [c for c in range(len(pixels)) if shown[c][k]]
        sights = [f"{c} {k} {float(pixels[c][k][0] - half[0])!r} {float(half[1] - pixels[c][k][1])!r}" for c in seen]
        lines += [" ".join(map(repr, point.tolist())), " ".join(map(str, color)), " ".join([str(len(seen)), *sights])]
    (folder / "bundle.out").write_text("\n".join(lines) + "\n")
    (folder / "list.txt").write_text("".join(f"images/{name}\n" for name in flight.names))
    return folder / "bundle.out"


def write_visualsfm(folder: Path, flight: KnownFlight, *, matrix: bool = False) -> Path:
    """.nvm of a lens without distortion, or of a `MeasuredLens`, with a quaternion or a matrix for each camera."""
    from scipy.spatial.transform import Rotation

    folder.mkdir(parents=True, exist_ok=True)
    lines = ["NVM_V3_R9T" if matrix else "NVM_V3 ", "", str(len(flight.names))]
    for name, pose, center in zip(flight.names, flight.poses, flight.centers, strict=True):
        turn = pose[:3, :3].ravel() if matrix else Rotation.from_matrix(pose[:3, :3]).as_quat()[[3, 0, 1, 2]]
        numbers = [
            flight.lens.focal,
            *turn,
            *(pose[:3, 3] if matrix else center),
            getattr(flight.lens, "radial", 0.0),
            0,
        ]
        lines.append("\t".join([f"images/{name}", " ".join(repr(float(each)) for each in numbers)]))
    lines += ["", str(len(flight.points))]
    for place, color, sights in _sights(flight, np.array(flight.lens.size) / 2):
        shown = " ".join(f"{index} 0 {x!r} {y!r}" for index, x, y in sights)
        lines.append(f"{' '.join(map(repr, place))} {' '.join(map(str, color))} {len(sights)} {shown}")
    file = folder / "model.nvm"
    file.write_text("\n".join([*lines, "", "0", ""]))
    return file


def _sights(
    flight: KnownFlight, origin: np.ndarray
) -> list[tuple[list[float], list[int], list[tuple[int, float, float]]]]:
    """Of each point its place and color, and which cameras show it where, from a pixel on."""
    pixels = [flight.pixels(index) - origin for index in range(len(flight.names))]
    shows = [flight.shows(index) for index in range(len(flight.names))]
    return [
        (point.tolist(), color.tolist(), [(c, *pixels[c][k].tolist()) for c in range(len(pixels)) if shows[c][k]])
        for k, (point, color) in enumerate(zip(flight.points, flight.colors, strict=True))
    ]


def write_openmvg(folder: Path, flight: KnownFlight, *, nested: bool = False) -> Path:
    """sfm_data.json by cereal, as its versions nest the lens."""
    lens, (width, height) = flight.lens, flight.lens.size
    pinhole = {"width": width, "height": height, "focal_length": lens.focal, "principal_point": list(lens.center)}
    values: dict[str, Any] = {"value0": pinhole} if nested else pinhole
    values = {**values, "disto_t2": [*lens.k[:3], *lens.p]}
    views = [
        {"local_path": "", "filename": name, "width": width, "height": height, "id_view": k, "id_intrinsic": 0,
         "id_pose": k}
        for k, name in enumerate(flight.names)
    ]  # fmt: skip
    poses = [
        {"key": k, "value": {"rotation": pose[:3, :3].tolist(), "center": center.tolist()}}
        for k, (pose, center) in enumerate(zip(flight.poses, flight.centers, strict=True))
    ]
    structure = [
        {"key": k, "value": {"X": place, "observations": [
            {"key": c, "value": {"id_feat": 0, "x": [x, y]}} for c, x, y in sights]}}
        for k, (place, _, sights) in enumerate(_sights(flight, np.zeros(2)))
    ]  # fmt: skip
    folder.mkdir(parents=True, exist_ok=True)
    content = {
        "sfm_data_version": "0.3", "root_path": "/home/u/images",
        "views": [{"key": k, "value": {"polymorphic_id": 1, "ptr_wrapper": {"id": k, "data": view}}}
                  for k, view in enumerate(views)],
        "intrinsics": [{"key": 0, "value": {"polymorphic_id": 2, "polymorphic_name": "pinhole_brown_t2",
                                            "ptr_wrapper": {"id": 99, "data": values}}}],
        "extrinsics": poses, "structure": structure, "control_points": [],
    }  # fmt: skip
    (folder / "sfm_data.json").write_text(json.dumps({**content, "extrinsics": [], "structure": []}))
    file = folder / "sfm_data_expanded.json"
    file.write_text(json.dumps(content))
    return file


def write_alicevision(
    folder: Path, flight: KnownFlight, version: tuple[int, int, int] = (1, 2, 6), **told_of_lens: str
) -> Path:
    """cameras.sfm: all numbers as texts, rotations column by column, lenses as the versions have them, or as said."""
    lens, (width, height) = flight.lens, flight.lens.size
    center, focal = np.array(lens.center), str(36 * lens.focal / width)
    if version >= (1, 2, 1):
        center = center - np.array(lens.size) / 2
    told = {"focalLength": focal, "sensorWidth": "36", "pixelRatio": "1"}
    if version < (1, 2, 0):
        told = {"pxFocalLength": str(lens.focal)}
    kind = {"type": "pinhole", "distortionType": "brown"} if version >= (1, 2, 7) else {"type": "brown"}
    intrinsic = {
        "intrinsicId": "7", "width": str(width), "height": str(height), **kind, **told,
        "principalPoint": [str(each) for each in center.tolist()],
        "distortionParams": [str(each) for each in (*lens.k[:3], *(lens.p if any(lens.p) else ()))],
        **told_of_lens,
    }  # fmt: skip
    poses = [
        {"poseId": str(k), "pose": {"transform": {"rotation": [str(each) for each in pose[:3, :3].T.ravel().tolist()],
                                                  "center": [str(each) for each in center.tolist()]}, "locked": "0"}}
        for k, (pose, center) in enumerate(zip(flight.poses, flight.centers, strict=True))
    ]  # fmt: skip
    views = [
        {"viewId": str(1000 + k), "poseId": str(k), "intrinsicId": "7", "path": f"D:/card/{name}", "width": str(width),
         "height": str(height), "metadata": {"Make": "DJI"}}
        for k, name in enumerate(flight.names)
    ]  # fmt: skip
    structure = [
        {"landmarkId": str(k), "descType": "dspsift", "color": list(map(str, color)), "X": list(map(str, place)),
         "observations": [{"observationId": str(1000 + c), "featureId": "1", "x": [str(x), str(y)], "scale": "2"}
                          for c, x, y in sights]}
        for k, (place, color, sights) in enumerate(_sights(flight, np.zeros(2)))
    ]  # fmt: skip
    folder.mkdir(parents=True, exist_ok=True)
    file = folder / "cameras.sfm"
    content = {"version": list(map(str, version)), "views": views, "intrinsics": [intrinsic], "poses": poses}
    file.write_text(json.dumps({**content, "structure": structure}))
    return file


def realityscan_lens(flight: KnownFlight) -> dict[str, float]:
    lens, (width, height), longer = flight.lens, flight.lens.size, max(flight.lens.size)
    names = dict(zip(("k1", "k2", "k3", "k4"), lens.k, strict=True))
    return {"f": 36 * lens.focal / longer, "px": (lens.center[0] - width / 2) / longer,
            "py": (lens.center[1] - height / 2) / longer, **names, "t1": lens.p[1], "t2": lens.p[0]}  # fmt: skip


def heading_pitch_roll(pose: np.ndarray) -> tuple[float, float, float]:
    """By the matrix camera from world that the maker publishes ("Registration export and camera orientations")."""
    r = pose[:3, :3]
    return (
        math.degrees(math.atan2(-r[1, 0], -r[1, 1])), math.degrees(math.asin(-r[1, 2])),
        math.degrees(math.atan2(-r[0, 2], -r[2, 2])),
    )  # fmt: skip


def write_realityscan_opencv_csv(file: Path, flight: KnownFlight) -> Path:
    """The table of RealityScan 2 in OpenCV's order and pixels."""
    lens = flight.lens
    columns = ",".join(f"R{row}{column}" for row in range(3) for column in range(3))
    lines = [f"#name,tx,ty,tz,{columns},f_pix,px_pix,py_pix,k1,k2,t2,t1,k3,k4"]
    for name, pose in zip(flight.names, flight.poses, strict=True):
        k1, k2, k3, k4 = lens.k
        numbers = [*pose[:3, 3], *pose[:3, :3].ravel(), lens.focal, *lens.center, k1, k2, *lens.p, k3, k4]
        lines.append(",".join([name, *(repr(float(each)) for each in numbers)]))
    file.write_text("\n".join(lines) + "\n")
    return file


def write_realityscan_csv(
    file: Path, flight: KnownFlight, centers: np.ndarray | None = None, poses: np.ndarray | None = None
) -> Path:
    lens = realityscan_lens(flight)
    lines = ["#name,x,y,alt,heading,pitch,roll," + ",".join(lens)]
    centers, poses = (flight.centers if centers is None else centers), (flight.poses if poses is None else poses)
    for name, pose, center in zip(flight.names, poses, centers, strict=True):
        numbers = (*center.tolist(), *map(float, heading_pitch_roll(pose)), *lens.values())
        lines.append(",".join([name, *map(repr, numbers)]))
    file.write_text("\n".join(lines) + "\n")
    return file


def write_realityscan_xmp(folder: Path, flight: KnownFlight, *, as_attributes: bool = False) -> None:
    lens = realityscan_lens(flight)
    bent = " ".join(repr(lens[key]) for key in ("k1", "k2", "k3", "k4", "t1", "t2"))
    for name, pose, center in zip(flight.names, flight.poses, flight.centers, strict=True):
        said = {"Rotation": " ".join(map(repr, pose[:3, :3].ravel().tolist())),
                "Position": " ".join(map(repr, center.tolist())), "DistortionCoeficients": bent}  # fmt: skip
        inside = "" if as_attributes else "".join(f"<xcr:{key}>{value}</xcr:{key}>" for key, value in said.items())
        around = "".join(f' xcr:{key}="{value}"' for key, value in said.items()) if as_attributes else ""
        (folder / name).with_suffix(".xmp").write_text(
            '<x:xmpmeta xmlns:x="adobe:ns:meta/"><rdf:RDF xmlns:rdf="http://www.w3.org/1999/02/22-rdf-syntax-ns#">'
            '<rdf:Description xcr:Version="3" xcr:PosePrior="locked" xcr:Coordinates="absolute" '
            f'xcr:DistortionModel="brown4t2" xcr:FocalLength35mm="{lens["f"]!r}" xcr:Skew="0" xcr:AspectRatio="1" '
            f'xcr:PrincipalPointU="{lens["px"]!r}" xcr:PrincipalPointV="{lens["py"]!r}"{around} '
            f'xmlns:xcr="http://www.capturingreality.com/ns/xcr/1.1#">{inside}</rdf:Description></rdf:RDF></x:xmpmeta>'
        )


def write_pix4d(project: Path, flight: KnownFlight, unit: float = 1.0) -> Path:
    """1_initial/params as PIX4Dmapper writes it: poses in the system of the project, less an offset."""
    import pyproj

    code, poses, _, centers = utm_flight(flight, unit)
    offset = np.round(centers.mean(axis=0))
    lens, params = flight.lens, project / "1_initial" / "params"
    params.mkdir(parents=True, exist_ok=True)
    lines = ["fileName imageWidth imageHeight ", "camera matrix K [3x3]", "radial distortion [3x1]",
             "tangential distortion [2x1]", "camera position t [3x1]", "camera rotation R [3x3]",
             "camera model m = K [R|-Rt] X", ""]  # fmt: skip
    matrix = np.array([[lens.focal, 0, lens.center[0]], [0, lens.focal, lens.center[1]], [0, 0, 1]])
    for name, pose, center in zip(flight.names, poses, centers, strict=True):
        rows = [*matrix, lens.k[:3], lens.p, center - offset, *pose[:3, :3]]
        lines.append(f"{name} {lens.size[0]} {lens.size[1]}")
        lines += [" ".join(repr(float(each)) for each in row) for row in rows]
    file = params / "flight_calibrated_camera_parameters.txt"
    file.write_text("\n".join(lines) + "\n")
    (params / "flight_offset.xyz").write_text(" ".join(map(str, offset)) + "\n")
    (params / "flight_wkt.prj").write_text(pyproj.CRS(code).to_wkt("WKT1_ESRI"))
    return file


def write_opf(folder: Path, flight: KnownFlight, unit: float = 1.0) -> Path:
    """project.opf and its files, after the examples of the specification (1.0)."""
    from scipy.spatial.transform import Rotation

    code, poses, points, centers = utm_flight(flight, unit)
    shift = -np.round(centers.mean(axis=0))
    lens = flight.lens
    (folder / "point_cloud").mkdir(parents=True, exist_ok=True)
    ids = [10**12 + k for k in range(len(flight.names))]
    turns = [Rotation.from_matrix((np.diag([1.0, -1.0, -1.0]) @ pose[:3, :3]).T) for pose in poses]
    cameras = [
        {"id": number, "sensor_id": 77, "position": (center + shift).tolist(),
         "orientation_deg": turn.as_euler("XYZ", degrees=True).tolist()}
        for number, turn, center in zip(ids, turns, centers, strict=True)
    ]  # fmt: skip
    internals = {"type": "perspective", "principal_point_px": list(lens.center), "focal_length_px": lens.focal,
                 "radial_distortion": list(lens.k[:3]), "tangential_distortion": list(lens.p)}  # fmt: skip
    listed = [{"id": i, "uri": f"file:///c:/data/images/{name}"} for i, name in zip(ids, flight.names, strict=True)]
    sensor = {"id": 77, "name": "DJI", "image_size_px": list(lens.size), "internals": internals}
    change = {"shift": shift.tolist(), "scale": [1.0, 1.0, 1.0], "swap_xy": False}
    documents: dict[str, tuple[str, dict[str, Any]]] = {
        "camera-list": ("camera_list", {"cameras": listed}),
        "input-cameras": ("input_cameras", {"sensors": [sensor], "captures": []}),
        "scene-reference-frame": (
            "scene_reference_frame", {"crs": {"definition": code}, "base_to_canonical": change}),
        "calibrated-cameras": ("calibration", {"sensors": [{"id": 77, "internals": internals}], "cameras": cameras}),
    }  # fmt: skip
    items: list[dict[str, Any]] = []
    for name, (kind, content) in documents.items():
        form = f"application/opf-{name}+json"
        (folder / f"{name}.json").write_text(json.dumps({"format": form, "version": "1.0", **content}))
        items.append({"id": kind, "type": kind, "resources": [{"uri": f"{name}.json", "format": form}], "sources": []})
    items[-1]["resources"].append({"uri": "point_cloud/sparse.gltf", "format": "model/gltf+json"})
    _write_gltf(folder / "point_cloud", points + shift, flight, ids)
    project = {"format": "application/opf-project+json", "version": "1.0", "id": "1", "name": "flight",
               "description": "", "generator": {"name": "PIX4Dmatic", "version": "1.41.0"}, "items": items}  # fmt: skip
    (folder / "project.opf").write_text(json.dumps(project))
    return folder / "project.opf"


def _write_gltf(folder: Path, points: np.ndarray, flight: KnownFlight, ids: list[int]) -> None:
    """Points, and by the extension of OPF which camera shows which: of a point a range in the list of sightings, its
    beginning in five bytes and its length in three."""
    (folder / "positions.bin").write_bytes(points.astype("<f4").tobytes())
    (folder / "colors.bin").write_bytes(b"".join(struct.pack("4B", *color, 255) for color in flight.colors.tolist()))
    pixels, shown = ([each(k) for k in range(len(ids))] for each in (flight.pixels, flight.shows))
    seen = [[k for k in range(len(ids)) if shown[k][point]] for point in range(len(points))]
    flat = [(k, *pixels[k][point]) for point, cameras in enumerate(seen) for k in cameras]
    starts = np.cumsum([0, *map(len, seen)])
    ranges = b"".join(
        int(first).to_bytes(5, "little") + len(each).to_bytes(3, "little")
        for first, each in zip(starts, seen, strict=False)
    )
    (folder / "ranges.bin").write_bytes(ranges)
    (folder / "cameras.bin").write_bytes(np.array([k for k, _, _ in flat], "<u4").tobytes())
    (folder / "pixels.bin").write_bytes(np.array([each[1:] for each in flat], "<f4").tobytes())
    n, m = len(points), len(flat)
    accessors = [{"bufferView": 0, "componentType": 5126, "count": n, "type": "VEC3"},
                 {"bufferView": 1, "componentType": 5121, "normalized": True, "count": n, "type": "VEC4"},
                 {"bufferView": 2, "componentType": 5125, "count": n, "type": "VEC2"},
                 {"bufferView": 3, "componentType": 5125, "count": m, "type": "SCALAR"},
                 {"bufferView": 4, "componentType": 5126, "count": m, "type": "VEC2"}]  # fmt: skip
    buffers = [(12 * n, "positions"), (4 * n, "colors"), (8 * n, "ranges"), (4 * m, "cameras"), (8 * m, "pixels")]
    matches = {"cameraUids": ids, "pointIndexRanges": 2, "cameraIds": 3, "imagePoints": {"pixelCoordinates": 4}}
    content = {
        "asset": {"version": "2.0", "extensions": {"OPF_asset_version": {"version": "1.0"}}},
        "scene": 0, "scenes": [{"nodes": [0]}], "accessors": accessors,
        "bufferViews": [{"buffer": k, "byteLength": size} for k, (size, _) in enumerate(buffers)],
        "buffers": [{"byteLength": size, "uri": f"{name}.bin"} for size, name in buffers],
        "meshes": [{"primitives": [{"attributes": {"POSITION": 0, "COLOR_0": 1}, "mode": 0,
                                    "extensions": {"OPF_mesh_primitive_matches": matches}}]}],
        "nodes": [{"mesh": 0, "matrix": [1, 0, 0, 0, 0, 0, -1, 0, 0, 1, 0, 0, 0, 0, 0, 1]}],
    }  # fmt: skip
    (folder / "sparse.gltf").write_text(json.dumps(content))
