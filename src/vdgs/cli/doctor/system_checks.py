"""The checks of `vdgs doctor`.

Nothing outside the standard library is imported at the top, so that the report also appears where a dependency is
broken: that is when it is needed.
"""

from __future__ import annotations

import importlib
import os
import platform
import re
import shutil
import sys
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path

from vdgs.cli.doctor import SystemCheck
from vdgs.cli.doctor.requirements import Requirement, installed_version, required_packages
from vdgs.kernels import cpu_count
from vdgs.system.broken_packages import explain_shadows, import_reason, imported_name, reinstall_command
from vdgs.system.cgroups import cgroup_limits, slurm_memory_limit
from vdgs.system.exit_codes import REMOVABLE_PACKAGES
from vdgs.system.stop_signals import preserve_signal_handlers
from vdgs.system.units import data_size

#: What each extra adds, for people; an extra that is not listed is reported without a sentence.
EXTRAS = {
    "synth": "the generated city, ray-traced (vdgs synth)",
    "lpips": "the linear heads of LPIPS",
    "tensorboard": "curves of the training in TensorBoard",
    "geo": "maps as GeoTIFFs, any EPSG system (vdgs ortho)",
    "video": "films instead of photographs (vdgs sfm FILM.MP4)",
    "photos": "HEIC and raw photographs (vdgs sfm)",
    "viewer": "a scene in a browser (vdgs view)",
    "ray": "blocks on many machines (--executor ray)",
    "gsplat": "another rasterizer on an NVIDIA GPU, to compare with",
    "test": "the test suite",
}
#: Imported for real, since these are the ones whose binary parts break.
BINARY_MODULES = ("torch", "numpy", "scipy", "cv2", "PIL", "safetensors", "matplotlib")
MIN_FREE_DISK_BYTES = 5 * 10**9


def _versions() -> list[SystemCheck]:
    python = platform.python_version()
    new_enough = sys.version_info >= (3, 11)
    remedy = "" if new_enough else "Install Python 3.11 or newer."
    return [
        SystemCheck("vdgs", "ok", installed_version("vdgs") or "not installed, run from a checkout"),
        SystemCheck("python", "ok" if new_enough else "broken", f"{python} on {platform.platform()}", remedy, True),
    ]


def hidden_packages() -> list[SystemCheck]:
    """The package that a file of its name hides, if any: others that import it may break in any way, or crash."""
    required = (imported_name(each.name) for each in required_packages()[""])
    if shadow := explain_shadows((*BINARY_MODULES, *required)):
        remedy = "The command `vdgs`, unlike `python -m vdgs`, does not look into the current folder."
        return [SystemCheck("dependencies", "broken", shadow, remedy, True)]
    return []


def _dependencies() -> list[SystemCheck]:
    """The packages that vdgs requires are installed in versions that will do, and the binary ones can be imported."""
    required = [each for each in required_packages()[""] if each.name not in REMOVABLE_PACKAGES]
    absent, unfit = _absent_and_unfit(required)
    broken = {name: error for name in BINARY_MODULES if (error := _import_error(name) or _numpy_error(name))}
    if not (absent or unfit or broken):
        return [SystemCheck("dependencies", "ok", "all installed, all can be imported", essential=True)]
    found = [f"{each.name} is not installed" for each in absent] + list(unfit.values())
    found += [f"{name} ({why})" for name, why in broken.items()]
    wanted = [each.pip_words() for each in (*absent, *unfit)]
    remedy = f"pip install {' '.join(wanted)}" if wanted else reinstall_command(tuple(broken))
    return [SystemCheck("dependencies", "broken", ", ".join(found), remedy, True)]


def _absent_and_unfit(required: list[Requirement]) -> tuple[list[Requirement], dict[Requirement, str]]:
    """Packages that are not installed, and those in versions that will not do: why not."""
    versions = {each: installed_version(each.name) for each in required}
    absent = [each for each, version in versions.items() if version is None]
    unfit = {each: why for each, version in versions.items() if version and (why := each.why_unfit(version))}
    return absent, unfit


def _removable_packages() -> list[SystemCheck]:
    """Packages that an installation may leave out: what does not work without each."""
    checks = []
    for each in required_packages()[""]:
        if (loss := REMOVABLE_PACKAGES.get(each.name)) is None:
            continue
        error, version = _import_error(each.name), installed_version(each.name)
        why = error or (each.why_unfit(version) if version else "")
        value = f"{why}: {loss.split('.')[0]}" if why else version or "installed"
        remedy = f"pip install {each.pip_words()}" if why else ""
        checks.append(SystemCheck(each.name, "missing" if why else "ok", value, remedy))
    return checks


def _processor() -> list[SystemCheck]:
    info = Path("/proc/cpuinfo").read_text() if Path("/proc/cpuinfo").is_file() else ""
    model = re.search(r"^model name\s*:\s*(.+)$", info, re.MULTILINE)
    name = model.group(1) if model else platform.processor() or platform.machine()
    return [SystemCheck("processor", "ok", f"{name}, {cpu_count()} of {os.cpu_count()} cores usable")]


def _kernels() -> list[SystemCheck]:
    """The C++ kernels: which builds load here, which one is in use."""
    from vdgs.kernels.cpu import extension

    built, errors = [], {}
    for name in extension.INSTRUCTION_SETS:
        try:
            extension.load_extension(name)
            built.append(name)
        except Exception as error:
            errors[name] = str(error)
    if not built:
        return [SystemCheck("native kernels", "missing", "not built", errors[extension.INSTRUCTION_SETS[-1]], True)]
    unbuilt = [name for name in errors if name in extension.supported_isas()]
    value = f"{extension.active_isa()} in use; available: {', '.join(built)}"
    if unbuilt:
        faster = f"The processor also runs {', '.join(unbuilt)}, which this installation lacks: reinstall vdgs."
        return [SystemCheck("native kernels", "note", value, faster, True)]
    return [SystemCheck("native kernels", "ok", value, essential=True)]


def _threads() -> list[SystemCheck]:
    import torch

    from vdgs.kernels import get_num_threads

    native = "none"
    with suppress(ImportError):  # not built, as another check says
        native = str(get_num_threads())
    policy = os.environ.get("OMP_WAIT_POLICY", "")
    checks = [SystemCheck("threads", "ok", f"kernels {native} (VDGS_THREADS), torch {torch.get_num_threads()}")]
    if policy.upper() == "PASSIVE":
        return [*checks, SystemCheck("OMP_WAIT_POLICY", "ok", "PASSIVE")]
    advice = "export OMP_WAIT_POLICY=PASSIVE: torch's spinning threads slow everything on a busy machine."
    return [*checks, SystemCheck("OMP_WAIT_POLICY", "note", policy or "not set", advice)]


def _memory() -> list[SystemCheck]:
    import psutil

    from vdgs.system.memory.process_memory import available_memory_bytes

    groups, memory, job = cgroup_limits(), psutil.virtual_memory(), slurm_memory_limit()
    total, free = min([memory.total, *(group.limit for group in groups)]), available_memory_bytes()
    by = "by a control group (container, SLURM job, systemd unit)"
    if total == memory.total and job is not None:  # as `available_memory_bytes` counts it
        total, by = min(total, job), "by what the SLURM job asked for"
    if total < memory.total:
        return [SystemCheck("memory", "ok", f"{data_size(free)} free, limited to {data_size(total)} {by}")]
    return [SystemCheck("memory", "ok", f"{data_size(free)} free of {data_size(total)}")]


def _torch() -> list[SystemCheck]:
    import torch

    checks = [
        SystemCheck("torch", "ok", f"{torch.__version__}, built for CUDA {torch.version.cuda or '–'}", essential=True)
    ]
    if torch.cuda.is_available():
        for index in range(torch.cuda.device_count()):
            device = torch.cuda.get_device_properties(index)
            checks.append(SystemCheck(f"GPU {index}", "ok", f"{device.name}, {data_size(device.total_memory)}"))
    elif shutil.which("nvidia-smi"):
        advice = "pip install --force-reinstall torch (the default build has CUDA); nvidia-smi tests the driver."
        checks.append(SystemCheck("GPU", "note", "there is an NVIDIA driver, but this torch cannot use it", advice))
    else:
        checks.append(SystemCheck("GPU", "note", "none: everything runs on the processor"))
    return checks


def _cuda() -> list[SystemCheck]:
    from vdgs.cli.doctor.cuda_checks import cuda_checks

    return cuda_checks()


def _extras() -> list[SystemCheck]:
    """Each optional group of packages: present, or what it would add and how to get it."""
    checks = []
    for extra, packages in required_packages().items():
        if not extra:
            continue
        absent, unfit = _absent_and_unfit(packages)
        adds = f": {EXTRAS[extra]}" if extra in EXTRAS else ""
        if absent or unfit:
            lacks = [f"lacks {', '.join(each.name for each in absent)}"] if absent else []
            value = ", ".join((*lacks, *unfit.values())) + adds
            checks.append(SystemCheck(f"extra {extra}", "missing", value, f"pip install 'vdgs[{extra}]'"))
        else:
            listed = ", ".join(f"{each.name} {installed_version(each.name)}" for each in packages[:3])
            listed += f" and {len(packages) - 3} more" if len(packages) > 3 else ""
            checks.append(SystemCheck(f"extra {extra}", "ok", listed + adds))
    return checks


def _lpips() -> list[SystemCheck]:
    """Both files of LPIPS, without reading half a gigabyte."""
    from vdgs.evaluation import lpips

    heads, weights = lpips.find_heads(), lpips.default_weights_path()
    if heads and weights.is_file():
        return [SystemCheck("LPIPS", "ok", f"VGG16 weights in {weights.parent}")]
    if heads:
        advice = f"Download {lpips.VGG16_URL} to {weights}, or give --lpips-weights PATH."
        return [SystemCheck("LPIPS", "missing", "no VGG16 weights; LPIPS will be null", advice)]
    return [SystemCheck("LPIPS", "missing", "no linear heads; LPIPS will be null", "pip install 'vdgs[lpips]'")]


def _video_encoding() -> list[SystemCheck]:
    """Encode a few frames for real."""
    import tempfile

    import numpy as np

    from vdgs.rendering import video

    encoder = video.default_encoder()
    try:
        with tempfile.TemporaryDirectory() as folder, video.VideoWriter(Path(folder) / "test.mp4", 30.0) as film:
            for level in (0, 128, 255):
                film.write(np.full((64, 96, 3), level, np.uint8))
    except Exception as error:
        return [SystemCheck("film", "missing", f"{encoder}: {error}", "pip install imageio-ffmpeg")]
    remedy = "" if video.caution(encoder) is None else "pip install imageio-ffmpeg for H.264, which all play."
    return [SystemCheck("film", "ok", video.CODECS[encoder], remedy)]


def _disk() -> list[SystemCheck]:
    usage = shutil.disk_usage(Path.cwd())
    value = f"{data_size(usage.free)} free of {data_size(usage.total)} in {Path.cwd()}"
    if usage.free < MIN_FREE_DISK_BYTES:
        return [SystemCheck("disk", "note", value, "Free some space: a run with its blocks may take several GB.")]
    return [SystemCheck("disk", "ok", value)]


def _import_error(module: str) -> str:
    try:
        with preserve_signal_handlers():
            importlib.import_module(module)
    except Exception as error:
        return f"{type(error).__name__}: {import_reason(error)}"
    return ""


def _numpy_error(module: str) -> str:
    """Why torch does not know numpy's arrays: it was built for another version. Not said when it is imported."""
    if module != "torch":
        return ""
    try:
        importlib.import_module("torch").from_numpy(importlib.import_module("numpy").zeros(1))
    except Exception as error:
        return f"{type(error).__name__}: {import_reason(error)}"
    return ""


_BASIC_CHECKS = (_versions, _dependencies, _removable_packages, _processor, _kernels, _threads, _memory, _torch)
CHECKS: tuple[Callable[[], list[SystemCheck]], ...] = (*_BASIC_CHECKS, _cuda, _extras, _lpips, _video_encoding, _disk)
