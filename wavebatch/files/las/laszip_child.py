"""Script that decompresses points with LASzip in a separate process, because a damaged file can crash LASzip.

`laszip_decode.py` starts it with: file, first point, point after the last, bytes per point. Raw records go to stdout.
It imports nothing of wavebatch, so that it starts fast.
"""

import contextlib
import sys

_PIECE = 10_000
_MEMORY = 1 << 31
_FAILED = 3


def main(path: str, start: int, stop: int, length: int) -> None:
    """Write the records [start, stop) of `path` to stdout; exit with a line on stderr if LASzip reports an error."""
    import laszip

    _limit_memory()
    buffer = bytearray(_PIECE * length)
    try:
        with open(path, "rb") as file:
            zipper = laszip.LasUnZipper(file)
            if start:
                zipper.seek(start)
            while start < stop:
                view = memoryview(buffer)[: min(_PIECE, stop - start) * length]
                zipper.decompress_into(view)
                sys.stdout.buffer.write(view)
                start += len(view) // length
        sys.stdout.buffer.flush()
    except BrokenPipeError:  # the reader needs no more points
        sys.stdout = None
    except (OSError, RuntimeError, ValueError, MemoryError, laszip.LaszipError) as error:
        sys.stderr.write(str(error) or type(error).__name__)
        sys.exit(_FAILED)


def _limit_memory() -> None:
    """Limits memory, because a damaged file can claim any size."""
    with contextlib.suppress(ImportError, ValueError, OSError):
        import resource

        resource.setrlimit(resource.RLIMIT_AS, (_MEMORY, _MEMORY))


if __name__ == "__main__":
    main(sys.argv[1], *map(int, sys.argv[2:5]))
