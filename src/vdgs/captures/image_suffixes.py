"""What files of photographs and films are called, which is asked before any library that decodes them is loaded."""

IMAGE_SUFFIXES = {".jpg", ".jpeg", ".png", ".tif", ".tiff", ".webp", ".bmp"}
TIFF_SUFFIXES = {".tif", ".tiff"}
#: Suffixes of raw files. What is a JPEG inside is none.
RAW_SUFFIXES = {
    ".dng", ".cr2", ".cr3", ".nef", ".arw", ".raf", ".orf", ".rw2", ".pef", ".srw", ".raw", ".gpr", ".3fr", ".iiq",
}  # fmt: skip
#: Photographs that a decoder of the extra `photos` reads, besides `RAW_SUFFIXES`, and those that Pillow may be built
#: with.
HEIF_SUFFIXES, AVIF_SUFFIXES = {".heic", ".heif", ".hif"}, {".avif"}
JPEG_SUFFIXES = {".jfif", ".jpe", ".jif", ".mpo"}
VIDEO_SUFFIXES = {
    ".mp4", ".mov", ".avi", ".mkv", ".mts", ".m2ts", ".m4v", ".insv", ".360", ".wmv", ".webm", ".3gp", ".ts", ".mpg",
    ".mpeg",
}  # fmt: skip
#: Copies of films in low resolution, which cameras write beside these (GoPro, DJI).
PROXY_SUFFIXES = {".lrv", ".lrf"}
OTHER_SUFFIXES = {".jxl", ".jp2", ".j2k", ".gif", ".psd", ".exr", ".hdr", ".tga", ".rjpeg", ".insp"}
#: Photographs of which only some installations read all, or none do.
OTHER_IMAGE_SUFFIXES = HEIF_SUFFIXES | AVIF_SUFFIXES | RAW_SUFFIXES | JPEG_SUFFIXES | OTHER_SUFFIXES
