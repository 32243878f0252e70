"""Pictures as a video file: the same pictures give the same bytes."""

from __future__ import annotations

from collections.abc import Iterable
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from fb3d_rl.children import withheld
from fb3d_rl.errors import UserError
from fb3d_rl.files import replacing


def require_encoder() -> None:
    """Check that ffmpeg is installed, so that a machine without it fails before any work.

    Raises:
        UserError: there is no ffmpeg.
    """
    try:
        import imageio_ffmpeg  # late: a machine that only trains has no need of it

        imageio_ffmpeg.get_ffmpeg_exe()
    except (ImportError, RuntimeError) as error:
        raise UserError("videos need ffmpeg; install it, or leave videos out: evaluation.videos=0") from error


_ENCODERS: dict[str, tuple[str, str, list[str]]] = {
    # The colour matrix is named in the file: players guess differently.
    ".mp4": ("libx264", "yuv420p", ["-preset", "medium", "-crf", "20", "-movflags", "+faststart",
                                    "-vf", "scale=out_color_matrix=bt709:out_range=tv:flags=accurate_rnd+bitexact,"
                                    "setparams=colorspace=bt709:color_primaries=bt709:color_trc=bt709"]),
    ".gif": ("gif", "pal8", ["-vf", "split[a][b];[a]palettegen=stats_mode=diff[p];[b][p]paletteuse=dither=bayer"]),
}  # fmt: skip


def encode(images: Iterable[NDArray[np.uint8]], path: Path, size: tuple[int, int], rate: int, hold: float) -> None:
    """Write pictures as a video, the last one held: H.264 that browsers play, or by the path's suffix a GIF.

    The same pictures give the same bytes: one thread encodes, and neither date nor version goes into the file.

    Args:
        images: at least one picture [height, width, 3] of uint8.
        path: ends in ``.mp4`` or ``.gif``.
        size: width and height of the pictures, even numbers of pixels.
        rate: pictures per second.
        hold: how long (s) the last one stays.
    """
    import imageio_ffmpeg

    codec, pixels, options = _ENCODERS[path.suffix]
    same = "-threads 1 -filter_threads 1 -map_metadata -1 -fflags +bitexact -flags +bitexact".split()
    with replacing(path) as part:
        writer = imageio_ffmpeg.write_frames(
            part,
            size,
            fps=rate,
            codec=codec,
            pix_fmt_out=pixels,
            quality=None,
            macro_block_size=1,
            ffmpeg_log_level="error",
            output_params=options + same,
        )
        with withheld():
            writer.send(None)  # starts ffmpeg
        for image in images:
            writer.send(image)
        for _ in range(round(hold * rate)):
            writer.send(image)
        writer.close()
