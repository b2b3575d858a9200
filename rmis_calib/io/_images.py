"""A folder of images as a source of frames. OpenCV decodes cut-off files without a word, so they are checked first."""

import contextlib
import struct
import warnings
import zlib
from collections.abc import Generator, Iterator, Sequence
from pathlib import Path

import cv2
import numpy as np
from PIL import Image

from rmis_calib.errors import FileError, VideoError
from rmis_calib.io._depth import bits_of, eight_bits
from rmis_calib.io.configs import read_bytes
from rmis_calib.io.folders import natural_order

SUFFIXES = (".jpg", ".jpeg", ".png", ".bmp", ".tif", ".tiff")
# Raw pixels are what the camera was calibrated on: no turning by what a file says about orientation.
_FLAGS = cv2.IMREAD_COLOR | cv2.IMREAD_ANYDEPTH | cv2.IMREAD_IGNORE_ORIENTATION
_LOOKED_AT = 16
"""Files, spread over the folder, from which the number of bits of 16-bit pictures is told."""


class ImageReader:
    """Images in the order of their names, one a frame; all of one size.

    Raises:
        VideoError: the folder holds something else than images, nothing, or names whose order is ambiguous; or the
            first image cannot be decoded.
    """

    times_s: np.ndarray | None = None

    def __init__(self, path: Path) -> None:
        self.path = path
        self.notes: tuple[str, ...] = ()
        self._files = [path] if path.is_file() else _list_images(path)
        self.count = len(self._files)
        self._bits = 8
        first = self._values(self._files[0])
        if first.dtype != np.uint8:
            stride = max(1, self.count // _LOOKED_AT)
            highest = max(int(self._values(file).max()) for file in self._files[::stride])
            self._bits = bits_of(highest)
            if self._bits < 16:
                self.notes = (f"{path.name}: 16-bit pictures with values up to {highest}, read as {self._bits} bits",)
        self.size: tuple[int, int] = first.shape[:2]

    def read_all(self, every: int = 1) -> Generator[np.ndarray, None, None]:
        """Every n-th frame from the first, (H, W, 3) uint8 RGB."""
        yield from self.read(range(0, self.count, every))

    def read(self, indices: Sequence[int]) -> Iterator[np.ndarray]:
        """Some frames, in the order asked for."""
        for index in indices:
            image = self._decode(self._files[index])
            if image.shape[:2] != self.size:
                expected = f"{self.size[1]} x {self.size[0]} px as in {self._files[0].name}"
                found = f"{image.shape[1]} x {image.shape[0]}"
                raise VideoError(where=str(self._files[index]), expected=expected, found=found)
            yield image

    def labels(self, indices: Sequence[int]) -> np.ndarray:
        """(n, h, w) numbers that pictures of classes hold: indices of a palette, else grey values.

        Raises:
            VideoError: a picture of colours, which number nothing.
        """
        return np.stack([_class_numbers(self._files[index]) for index in indices])

    def _decode(self, path: Path) -> np.ndarray:
        values = self._values(path)
        return values if values.dtype == np.uint8 else eight_bits(values, self._bits, str(path))

    @staticmethod
    def _values(path: Path) -> np.ndarray:
        """(h, w, 3) RGB, uint8 or uint16 as in the file; palettes are looked up, and transparency is left out."""
        try:
            data = read_bytes(path)
        except FileError as error:
            raise VideoError(str(error)) from error
        problem = _truncation(data)
        if problem:
            raise VideoError(where=str(path), expected="a complete image", found=problem)
        try:
            image = cv2.imdecode(np.frombuffer(data, np.uint8), _FLAGS)
        except cv2.error:
            image = None
        if image is None:
            _check_memory(path)
            raise VideoError(where=str(path), expected="an image", found="a file that cannot be decoded")
        if image.dtype not in (np.uint8, np.uint16):
            expected = "pictures of 8 to 16 bits a colour"
            raise VideoError(where=str(path), expected=expected, found=f"{image.dtype} numbers")
        return cv2.cvtColor(image, cv2.COLOR_BGR2RGB)


def _check_memory(path: Path) -> None:
    """Tell a picture that memory cannot hold from one that is no picture: the decoder says neither.

    Raises:
        MemoryError: it is larger than what is left.
    """
    with contextlib.suppress(OSError, ValueError, Image.DecompressionBombError), warnings.catch_warnings():
        warnings.simplefilter("ignore")
        with Image.open(path) as picture:
            width, height = picture.size
        bytearray(6 * width * height)  # the decoder's copy and ours


def _class_numbers(path: Path) -> np.ndarray:
    """(h, w) numbers of one picture."""
    try:
        with Image.open(path) as picture:
            numbers = np.asarray(picture)
            has_palette = picture.mode == "P"
    except (OSError, ValueError, Image.DecompressionBombError) as error:
        raise VideoError(where=str(path), expected="an image", found="a file that cannot be decoded") from error
    if numbers.ndim == 3 and not has_palette:
        if np.ptp(numbers[..., :3].astype(np.int64), axis=-1).max() > 0:
            raise VideoError(where=str(path), expected="grey or palette pictures of class numbers", found="colours")
        numbers = numbers[..., 0]
    return numbers.astype(np.int64)


def _list_images(folder: Path) -> list[Path]:
    files = sorted(path for path in folder.iterdir() if not path.name.startswith("."))
    for path in files:
        if path.suffix.lower() not in SUFFIXES or not path.is_file():
            raise VideoError(where=str(folder), expected="images only (jpg, png, bmp, tif)", found=path.name)
    if not files:
        raise VideoError(where=str(folder), expected="a folder of images", found="an empty one")
    by_number = sorted(files, key=lambda path: natural_order(path.name))
    if by_number != files:
        first = next(i for i, (a, b) in enumerate(zip(files, by_number, strict=True)) if a != b)
        found = f"{files[first].name} before {by_number[first].name}: pad the numbers with zeros"
        raise VideoError(where=str(folder), expected="names that sort alike as text and by number", found=found)
    return files


def _truncation(data: bytes) -> str:
    """What is missing at the end of an image file; empty for a complete file, or for a kind that is not looked into."""
    if not data:
        return "an empty file (0 bytes)"
    if data.startswith(b"\xff\xd8"):
        return "" if _jpeg_is_complete(data) else "a JPEG without its end: truncated"
    if data.startswith(b"\x89PNG\r\n\x1a\n"):
        return _png_problem(data)
    if data.startswith(b"BM") and len(data) >= 38:
        return "" if _bmp_is_complete(data) else "a BMP without its last rows: truncated"
    return ""


def _jpeg_is_complete(data: bytes) -> bool:
    """Whether the end-of-image marker follows the picture itself; a thumbnail in the header has one of its own."""
    position = 2
    while position + 4 <= len(data) and data[position] == 0xFF:
        marker, length = data[position + 1], int.from_bytes(data[position + 2 : position + 4])
        if marker == 0xFF:  # a fill byte before the marker
            position += 1
            continue
        position += 2 + length
        if marker == 0xDA:  # Start of scan. In the coded data FF is always followed by 00, so FF D9 is the marker.
            return data.find(b"\xff\xd9", position) >= 0
    return False


def _png_problem(data: bytes) -> str:
    position = 8
    while position + 12 <= len(data):
        length, kind = struct.unpack_from(">I4s", data, position)
        end = position + 12 + length
        if end > len(data):
            break
        if zlib.crc32(memoryview(data)[position + 4 : end - 4]) != int.from_bytes(data[end - 4 : end]):
            return "a PNG with a damaged part (wrong checksum)"
        if kind == b"IEND":
            return ""
        position = end
    return "a PNG without its end: truncated"


def _bmp_is_complete(data: bytes) -> bool:
    offset, _, width, height, _, bits, compression = struct.unpack_from("<IIiiHHI", data, 10)
    stride = (abs(width) * bits + 31) // 32 * 4
    # Compressed bitmaps have no size that follows from the header.
    return compression not in (0, 3) or len(data) >= offset + stride * abs(height)
