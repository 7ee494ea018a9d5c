"""What leads from a Metashape chunk, or from each of its components, to metres: the transforms of a file, in metres and
without."""

from __future__ import annotations

import re
from collections.abc import Mapping
from pathlib import Path
from xml.etree.ElementTree import Element

import numpy as np

from vdgs.captures.formats.source_capture import to_rigid
from vdgs.captures.formats.xml_documents import xml_numbers
from vdgs.captures.system_names import is_local_system
from vdgs.errors import CaptureError
from vdgs.geometry.geodesy import SEMI_MAJOR_M
from vdgs.geometry.similarity import Similarity

#: Places so far from the middle of the Earth are on the globe (metres).
_ON_GLOBE_M = (SEMI_MAJOR_M - 60_000, SEMI_MAJOR_M + 60_000)
#: The unit of a local coordinate system and the metres in one.
_UNIT = re.compile(r"\bUNIT\[\s*\"([^\"]+)\"\s*,\s*(\d*\.?\d+(?:[eE][+-]?\d+)?)\s*[,\]]")
#: Cameras and their references spread alike up to so much (logarithm of the ratio; choice).
SAME_SIZE = 0.2
_FALSE = ("0", "false")


class ChunkTransforms:
    """The transforms of a chunk, by component, and by "" that of the chunk itself, in files of versions that know no
    components. Raises `CaptureError` for a damaged one."""

    def __init__(self, chunk: Element, file: Path) -> None:
        self._element, self._file = chunk, file
        self.warnings: list[str] = []
        found, turns = dict[str, Similarity](), dict[str, Similarity]()
        for component in [*chunk.iter("component"), chunk]:
            transform = component.find("transform")
            if transform is not None:
                key = component.get("id", "") if component is not chunk else ""
                similarity = self._similarity(transform)
                (found if self._counts_in_meters(transform, similarity) else turns)[key] = similarity
        meters = self._meters_per_unit(found)
        #: From each component to the world, in metres.
        self.metric = {
            key: Similarity(meters * each.scale, each.rotation, meters * each.translation)
            for key, each in found.items()
        }
        #: Those that only turn and move a component: nothing says what it counts in.
        self.turns = turns

    def _counts_in_meters(self, transform: Element, similarity: Similarity) -> bool:
        """Not so where it has no scale, as that of a chunk without references, which a person turned. The scale 1 is
        none either, unless the file names a coordinate system or references.

        On the globe all are: nothing but references brings a chunk there.
        """
        if is_on_globe(similarity.translation):
            return True
        if transform.find("rotation") is None and (transform.text or "").strip():
            has_scale = True  # the one matrix of old files
        else:
            has_scale = bool((transform.findtext("scale") or "").strip())
        return has_scale and (similarity.scale != 1 or bool(self.wkt) or self._has_references())

    def _has_references(self) -> bool:
        """Whether cameras, markers or scale bars have references that are in use."""
        return any(
            each.get("enabled", "1").lower() not in _FALSE and (each.get("x") or each.get("distance"))
            for each in self._element.iter("reference")
        )

    @property
    def wkt(self) -> str:
        """The coordinate system of the chunk; empty where it names none."""
        reference = next((each for each in self._element.findall("reference") if (each.text or "").strip()), None)
        return (reference.text or "").strip() if reference is not None else ""

    def _meters_per_unit(self, transforms: Mapping[str, Similarity]) -> float:
        """What the transforms count in where local coordinates are of another unit than metres: metres as everywhere
        in Metashape, unless the cameras' references, which are in the unit, say that they count in it, too."""
        unit = _UNIT.search(self.wkt) if is_local_system(self.wkt) else None
        meters = float(unit[2]) if unit is not None else 1.0
        if unit is None or not meters > 0 or abs(meters - 1) < 1e-3:
            return 1.0
        places, references = self._places_and_references(transforms)
        spread = [float(np.sqrt(np.var(each, axis=0).sum())) if len(each) > 2 else 0.0 for each in (places, references)]
        ratio = spread[1] / spread[0] if min(spread) > 0 else 0.0
        counts_in_unit = bool(ratio) and abs(np.log(ratio)) < SAME_SIZE
        shown = counts_in_unit or (bool(ratio) and abs(np.log(ratio * meters)) < SAME_SIZE)
        why = "as the references of its cameras show" if shown else "which nothing in the file shows"
        taken = unit[1] if counts_in_unit else "metres"
        self.warnings.append(f"its local coordinates are in {unit[1]}; its poses are taken as {taken}, {why}.")
        return meters if counts_in_unit else 1.0

    def _places_and_references(
        self, transforms: Mapping[str, Similarity]
    ) -> tuple[list[np.ndarray], list[list[float]]]:
        """Where cameras are by their poses, and by their references, of those that have both."""
        places, references = [], []
        for camera in self._element.iter("camera"):
            pose, reference = camera.find("transform"), camera.find("reference")
            number = camera.get("component_id", "")
            key = number if number in transforms else next(iter(transforms), "")
            words = [reference.get(axis, "") for axis in "xyz"] if reference is not None else []
            if pose is not None and key in transforms and words and all(words):
                label = f"camera {camera.get('label', '?')!r}"
                matrix = xml_numbers(pose.text, 16, self._file, f"the transform of {label}")
                places.append(transforms[key].apply(np.array(matrix[3:12:4])))
                references.append(xml_numbers(" ".join(words), 3, self._file, f"the reference of {label}"))
        return places, references

    def _similarity(self, transform: Element) -> Similarity:
        label = "the transform of the chunk"
        if transform.find("rotation") is None and (transform.text or "").strip():
            matrix = np.array(xml_numbers(transform.text, 16, self._file, label)).reshape(4, 4)
            scale = float(np.cbrt(np.linalg.det(matrix[:3, :3])))
            rotation, translation = matrix[:3, :3] / (scale or 1.0), matrix[:3, 3]
        else:
            texts = {name: transform.findtext(name) for name in ("rotation", "translation", "scale")}
            rotation = np.array(xml_numbers(texts["rotation"] or "1 0 0 0 1 0 0 0 1", 9, self._file, label))
            translation = np.array(xml_numbers(texts["translation"] or "0 0 0", 3, self._file, label))
            scale = xml_numbers(texts["scale"] or "1", 1, self._file, label)[0]
        if not 1e-12 < scale < 1e12:
            raise CaptureError(f"{self._file}: {label} has the scale {scale}. The file is damaged; export it again.")
        rigid = to_rigid(np.column_stack([rotation.reshape(3, 3), np.zeros(3)]), self._file, label)
        return Similarity(scale, rigid[:3, :3], translation)


def is_on_globe(place: np.ndarray) -> bool:
    """Whether a place [3] in Earth-centred metres is near the surface of the Earth."""
    return _ON_GLOBE_M[0] < float(np.linalg.norm(place)) < _ON_GLOBE_M[1]
