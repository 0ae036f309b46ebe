"""Names the FFmpeg libraries inside PyAV's wheel as torchcodec looks for them; prints the folder for LD_LIBRARY_PATH.

torchcodec brings no FFmpeg. The names in the wheel have a hash: ``libavcodec-7ee0753d.so.61.19.101`` is ``libavcodec.so.61``.
"""

from __future__ import annotations

import re
import sys
from pathlib import Path

import av

folder = Path(av.__file__).parents[1] / "av.libs"
for library in folder.glob("lib*.so.*"):
    named = re.fullmatch(r"(lib(?:av\w+|sw\w+))-[0-9a-f]+\.so\.(\d+)\.[\d.]+", library.name)
    if named:
        link = folder / f"{named[1]}.so.{named[2]}"
        link.unlink(missing_ok=True)
        link.symlink_to(library.name)
sys.stdout.write(f"{folder}\n")
