"""How systems and programs name copies and edited versions of photographs."""

from __future__ import annotations

import re
import unicodedata
from pathlib import PurePosixPath

#: What Google Photos puts behind the name of what was edited, in the languages of its users; for regular expressions.
EDITED_WORDS = "|".join(
    (
        "edited", "bearbeitet", "modifié", "(?:ha[ _])?editado", "editada", "editat", "modificato", "modificata",
        "bewerkt", "edytowane", "redigerad", "redigeret", "redigert", "muokattu", "upraveno", "upravené",
        "szerkesztett", "szerkesztve", "editată", "düzenlendi", "изменено", "змінено", "編集済み", "已编辑", "编辑",
        "已編輯", "수정됨",
    )
)  # fmt: skip
_COPY_NAME = re.compile(
    r"(?P<first>.+?)(?:[ _–—-]+(?:copy|copie|kopie|copia|cópia|kopia|kopi|kopio|kopya|kópia|másolat|копия|копія"
    r"|αντιγραφή|コピー|副本|복사본)(?:[ _]?\(?\d{1,2}\)?)?"
    rf"|[-_~](?:{EDITED_WORDS}|edit|crop|cropped|hdr|enhanced(?:-(?:nr|sr|rd)){{0,3}})(?P<double>\(\d{{1,2}}\))?)",
    re.IGNORECASE,
)
#: What Google Drive and systems put in front of the name of a copy: "Copy of DJI_0002.JPG".
_COPY_OF = re.compile(
    r"(?:copy[ _]of|kopie[ _]v[ao]n|copie[ _]de|c[oó]pia[ _]d[eio]|kopia|kopi[ _]a[vf]|копия)[ _]+(?P<first>.+)",
    re.IGNORECASE,
)
#: How people name folders of copies.
_COPY_FOLDER = re.compile(
    r"(?:^|[\W_])(?:cop(?:y|ies)|copie|kopien?|copias?|backups?|bak|duplicates?|doubles?|sicherung)(?:[\W_\d]|$)"
    r"|\(\d{1,2}\)$",
    re.IGNORECASE,
)
#: How programs that convert photographs name them where they keep the ending: DJI_0001.JPG.jpg.
_CONVERTED = re.compile(r"(.+)\.(?:jpe?g|jpe|jfif|png|tiff?|dng|heic|heif|webp)", re.IGNORECASE)
#: How iPhones name what was edited: IMG_E0001.JPG beside IMG_0001.HEIC.
_EDITED_ON_PHONE = re.compile(r"(.*\bIMG_)E(\d{4})", re.IGNORECASE)


def first_stems(stem: str) -> list[str]:
    """What the photograph may be called, in lower case and without an ending, of which one of this stem is a copy or an
    edited version; none for other stems."""
    stem = unicodedata.normalize("NFC", stem)
    if match := _EDITED_ON_PHONE.fullmatch(stem):
        return ["".join(match.groups()).lower()]
    if match := _CONVERTED.fullmatch(stem):
        return [match[1].lower()]
    if match := _COPY_OF.fullmatch(stem):
        return [match["first"].lower()]
    if match := _COPY_NAME.fullmatch(stem):
        return list(dict.fromkeys((f"{match['first']}{match['double'] or ''}".lower(), match["first"].lower())))
    return []


def say_copy(path: PurePosixPath) -> bool:
    """Whether the name of a photograph, or of a folder that it is in, says that it is a copy."""
    return bool(first_stems(path.stem)) or any(map(_COPY_FOLDER.search, (*path.parts[:-1], path.stem)))
