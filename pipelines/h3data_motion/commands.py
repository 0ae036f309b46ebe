"""Commands ``h3data motion``: import of motion capture (AMASS, Habitat, BVH), and pictures of it."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any, Literal

import numpy as np
import tyro
from numpy.typing import NDArray

from h3data.bodies import Humanoid, load_humanoid
from h3data.commands.command import ForceFlag, Group, JsonFlag, Outcome, claim_file
from h3data.errors import FormatError, H3DataError, InputError
from h3data.progress import progress
from h3data_motion.clip import Motion
from h3data_motion.cycle import trim_to_cycle
from h3data_motion.files import (
    ReadOptions,
    motion_kind,
    motion_suffixes,
    read_motion,
    save_motion,
)
from h3data_motion.retarget import foot_report, retarget

KindChoice = Annotated[
    Literal["auto", "motion", "amass", "habitat", "bvh"],
    tyro.conf.arg(help="Format of the files; auto detects it from their contents."),
]
UpChoice = Annotated[Literal["z", "y"], tyro.conf.arg(help="AMASS: up axis of the file's world frame.")]
FpsChoice = Annotated[float | None, tyro.conf.arg(help="AMASS: frame rate [1/s] of files that do not state it.")]
NamesChoice = Annotated[
    str | None,
    tyro.conf.arg(
        help="BVH: joint names: cmu, cgspeed, daz, mixamo, rokoko, xsens, lafan or a TOML file (default: what fits)."
    ),
]
UnitChoice = Annotated[
    float | None, tyro.conf.arg(help="BVH: metres per unit (default: the unit that gives legs of human length).")
]


@dataclass(frozen=True)
class MotionImport:
    """Convert motion files to .npz files that all h3data commands read.

    Folders are searched recursively. Without --body, the motion stays as recorded and is retargeted at each use. With
    --body, it is retargeted once.

    Examples:
        h3data motion import walk.bvh -o motions/
        h3data motion import ~/amass/CMU -o motions/ --body female_1 --source "AMASS CMU, non-commercial licence"
        h3data motion import odd_names.bvh -o motions/ --names my_names.toml --unit-m 0.01
    """

    paths: tyro.conf.Positional[tuple[Path, ...]]
    """Motion files (.npz, .pkl, .bvh) or folders of them."""
    out: Annotated[Path, tyro.conf.arg(aliases=["-o"])]
    """Folder for the converted motions; files from a folder keep their relative paths."""
    body: str | None = None
    """Built-in body or .npz file to retarget to."""
    kind: KindChoice = "auto"
    up: UpChoice = "z"
    fps: FpsChoice = None
    names: NamesChoice = None
    unit_m: UnitChoice = None
    source: str = ""
    """Origin and licence, stored in the files."""
    force: ForceFlag = False
    json: JsonFlag = False

    def run(self) -> Outcome:
        """Convert all files and return a report with a row for each.

        Raises:
            InputError: there is nothing to import, or the only file cannot be read.
        """
        if not self.paths:
            raise InputError("Expected at least one file or folder to import.", code="H3-BODY-129")
        options = _options(self.up, self.fps, self.names, self.unit_m, self.source)
        body = load_humanoid(self.body) if self.body else None
        sources = _collect(self.paths, self.out)
        if len(sources) == 1 and sources[0][0] in self.paths:
            # A single file that cannot be read is an error of the command, not a row of its report.
            return _report([self._convert(*sources[0], body, options, set())])
        rows: list[dict[str, Any]] = []
        written: set[Path] = set()
        for path, target in progress(sources, desc="motion import", unit="file"):
            try:
                if self.kind == "auto":
                    motion_kind(path)
            except FormatError as error:
                rows.append({"source": str(path), "status": "skipped", "reason": str(error), "code": error.code})
                continue
            except InputError as error:
                rows.append({"source": str(path), "status": "failed", "reason": str(error), "code": error.code})
                continue
            try:
                rows.append(self._convert(path, target, body, options, written))
            except H3DataError as error:
                rows.append({"source": str(path), "status": "failed", "reason": str(error), "code": error.code})
        return _report(rows)

    def _convert(
        self, path: Path, target: Path, body: Humanoid | None, options: ReadOptions, written: set[Path]
    ) -> dict[str, Any]:
        kind = motion_kind(path) if self.kind == "auto" else self.kind
        motion = read_motion(path, kind=kind, options=options)
        if target in written:
            raise InputError(
                f"Another input of this run was written to {target}. Give this one a different -o: {path}",
                code="H3-BODY-130",
            )
        row: dict[str, Any] = {"source": str(path), "status": "imported", "kind": kind, "motion": str(target)}
        if body is not None:
            motion = retarget(motion, body)
            feet = foot_report(motion, body)
            row |= {"feet_on_floor": feet.touching, "slide_mm": feet.slide_mm}
        claim_file(target, force=self.force)
        save_motion(motion, target)
        written.add(target)
        return {**row, **_facts(motion)}


@dataclass(frozen=True)
class MotionShow:
    """Render motion as poses side by side (.png, .jpg) or as a video (.mp4); without -o, only print facts about it.

    Examples:
        h3data motion show walk.bvh
        h3data motion show walk.bvh dance.npz -o strips.png --body male_1
        h3data motion show walk.bvh -o walk.mp4
        h3data motion show walk.bvh -o cycle.png --cycle
    """

    paths: tyro.conf.Positional[tuple[Path, ...]]
    """Motion files: imported, AMASS, Habitat or BVH."""
    out: Annotated[Path | None, tyro.conf.arg(aliases=["-o"])] = None
    """PNG, JPEG or MP4 file to write."""
    body: str = "neutral_0"
    """Built-in body or .npz file that performs the motion."""
    frames: int = 8
    """Number of poses per motion."""
    cycle: bool = False
    """Find and show a single gait cycle."""
    width: int = 1600
    """Width of the image [pixels]; videos are 960x540."""
    kind: KindChoice = "auto"
    up: UpChoice = "z"
    fps: FpsChoice = None
    names: NamesChoice = None
    unit_m: UnitChoice = None
    force: ForceFlag = False
    json: JsonFlag = False

    def run(self) -> Outcome:
        """Render the motion, and return facts about it."""
        if not self.paths:
            raise InputError("Expected at least one motion file.", code="H3-BODY-131")
        if not 1 <= self.frames <= 32 or not 200 <= self.width <= 8000:
            raise InputError(
                f"Expected --frames 1 to 32 and --width 200 to 8000, got {self.frames} and {self.width}.",
                code="H3-BODY-132",
            )
        video = self.out is not None and self.out.suffix.lower() == ".mp4"
        if self.out is not None and not video and self.out.suffix.lower() not in (".png", ".jpg", ".jpeg"):
            raise InputError(
                f"Expected a file name that ends in .png, .jpg or .mp4, got: {self.out}", code="H3-BODY-133"
            )
        if video and len(self.paths) > 1:
            raise InputError(f"A video shows one motion, got {len(self.paths)} files.", code="H3-BODY-134")
        if video and self.cycle:
            raise InputError("--cycle applies to images only; a video shows the whole motion.", code="H3-BODY-135")
        options = _options(self.up, self.fps, self.names, self.unit_m, "")
        body = load_humanoid(self.body)
        motions = [retarget(read_motion(p, kind=self.kind, options=options), body) for p in self.paths]
        rows = [self._row(motion, body) for motion in motions]
        text = "\n".join(_line(row) for row in rows)
        if self.out is None:
            return Outcome(text=text, data={"motions": rows})
        target = claim_file(self.out, force=self.force)
        data: dict[str, Any] = {"file": str(target), "motions": rows}
        if video:
            data["frames"] = write_video(motions[0], body, self.body, target)
        else:
            self._write_strips(motions, body, target)
        return Outcome(text=f"{text}\nwrote {target}", data=data)

    def _row(self, motion: Motion, body: Humanoid) -> dict[str, Any]:
        feet = foot_report(motion, body)
        row = {"name": motion.name, **_facts(motion), "feet_on_floor": feet.touching, "slide_mm": feet.slide_mm}
        if self.cycle:
            clip = trim_to_cycle(motion, body)
            row |= {
                "cycle_s": clip.period_s,
                "stride_m": clip.stride_m,
                "speed_mps": clip.speed_mps,
                "turn_deg": float(np.degrees(clip.turn_rad)),
            }
        return row

    def _write_strips(self, motions: list[Motion], body: Humanoid, target: Path) -> None:
        from h3data.render.image_files import write_image
        from h3data_motion.pictures import clip_picture, motion_picture

        strips = []
        for motion in motions:
            if self.cycle:
                strip = clip_picture(trim_to_cycle(motion, body), body, frames=self.frames, width=self.width)
            else:
                strip = motion_picture(motion, body, frames=self.frames, width=self.width)
            strips.append(_labelled(strip, motion.name))
        write_image(target, np.concatenate(strips))


MOTION = Group(
    "Motion capture: import AMASS, Habitat and BVH files, show them on our bodies.",
    {"import": MotionImport, "show": MotionShow},
)


# --- files ----------------------------------------------------------------------------------------------------------------
def _options(
    up: Literal["z", "y"], fps: float | None, names: str | None, unit_m: float | None, source: str
) -> ReadOptions:
    for flag, value in (("--fps", fps), ("--unit-m", unit_m)):
        if value is not None and not 0 < value < 1e4:
            raise InputError(f"{flag} must be above 0 and below 10000, got {value}.", code="H3-BODY-136")
    return ReadOptions(up=up, fps=fps, names=names, unit_m=unit_m, source=source)


def _collect(paths: tuple[Path, ...], out: Path) -> list[tuple[Path, Path]]:
    """Return the pairs of input file and output file; files from a folder keep their relative paths."""
    suffixes = motion_suffixes()
    sources: list[tuple[Path, Path]] = []
    for path in paths:
        if path.is_dir():
            files = sorted(p for p in path.rglob("*") if p.is_file() and p.suffix.lower() in suffixes)
            if not files:
                raise InputError(
                    f"Expected {', '.join(suffixes)} files, there are none in this folder: {path}", code="H3-BODY-137"
                )
            sources += [(p, out / p.relative_to(path).parent / f"{p.stem}.npz") for p in files]
        elif path.exists():
            sources.append((path, out / f"{path.stem}.npz"))
        else:
            raise InputError(
                f"Expected a motion file (.npz, .pkl, .bvh) or a folder, this does not exist: {path}",
                code="H3-BODY-138",
            )
    return sources


def _facts(motion: Motion) -> dict[str, Any]:
    return {
        "frames": len(motion),
        "fps": motion.fps,
        "seconds": round(motion.duration_s, 3),
        "path_m": round(motion.path_m, 3),
        "leg_m": motion.leg_m,
        "body": motion.body,
        "source_note": motion.source,
    }


def _line(row: dict[str, Any]) -> str:
    text = f"{row['name']:<28} {row['seconds']:8.2f} s {row['fps']:6g} frames/s  path {row['path_m']:6.2f} m"
    if "slide_mm" in row:
        text += f"  feet slide {row['slide_mm']:.2f} mm per step"
    if "cycle_s" in row:
        pace = f"{row['speed_mps']:.2f} m/s, stride {row['stride_m']:.2f} m" if row["speed_mps"] > 0 else "in place"
        turn = f", turns {row['turn_deg']:.0f} degrees" if row["turn_deg"] else ""
        text += f"\n  cycle of {row['cycle_s']:.2f} s, {pace}{turn}"
    return text


def _report(rows: list[dict[str, Any]]) -> Outcome:
    counts = {status: sum(row["status"] == status for row in rows) for status in ("imported", "skipped", "failed")}
    lines = []
    for row in rows:
        if row["status"] == "imported":
            retargeted = f", retargeted to {row['body']}" if row["body"] else ""
            lines.append(
                f"imported {row['kind']:<8} {row['source']} -> {row['motion']}  {row['seconds']:.2f} s at {row['fps']:g}/s, "
                f"path {row['path_m']:.2f} m{retargeted}"
            )
        else:
            lines.append(f"{row['status']:<8} {row['source']}: {row['reason']}")
    if len(rows) > 1:
        lines.append(", ".join(f"{count} {status}" for status, count in counts.items()))
    failed = counts["failed"] or not counts["imported"]
    return Outcome(text="\n".join(lines), data={**counts, "files": rows}, exit_code=1 if failed else 0)


# --- pictures -------------------------------------------------------------------------------------------------------------
def _labelled(picture: NDArray[np.uint8], text: str) -> NDArray[np.uint8]:
    import cv2

    out = np.ascontiguousarray(picture)
    size = out.shape[1] / 2400
    cv2.putText(
        out, text, (round(20 * size), round(40 * size)), cv2.FONT_HERSHEY_SIMPLEX, size, (40, 44, 52), 1, cv2.LINE_AA
    )
    return out


def write_video(motion: Motion, body: Humanoid, name: str, target: Path) -> int:
    """Write an MP4 of a body performing a motion, at 30 frames/s, and return the number of frames.

    ``name`` is the name of a built-in body or the path of the body's .npz file.
    """
    from h3data.render import VideoWriter
    from h3data.replay import Replay
    from h3data_motion.pictures import follow_camera
    from h3data_motion.recording import motion_recording

    replay = Replay(motion_recording(motion, body, model=f"humanoid/{name}"))
    track = follow_camera(replay)
    with VideoWriter(target, track.camera.width, track.camera.height) as video:
        frames = replay.frames([track], range(len(replay)), outputs=("rgb",), samples=4)
        for _, (picture,) in progress(frames, total=len(replay), desc="video", unit="frame"):
            video.write(picture["rgb"])
    return len(replay)
