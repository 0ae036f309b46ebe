"""Export of recordings as a LeRobot v3.0 dataset, with the columns that LeRobot's policies require."""

from __future__ import annotations

import shutil
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import AbstractContextManager, contextmanager, nullcontext
from dataclasses import replace
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np

from h3data.errors import InputError
from h3data.formats import Exported, ExportRequest
from h3data.recording.demonstrations import (
    DemonstratedAgent,
    DemonstratedCamera,
    DemonstratedScene,
    Demonstrations,
    write_demonstrations,
)
from h3data.recording.parquet.videos import EpisodeVideo, VideoFeature
from h3data.recording.parquet.writer import DatasetWriter
from h3data.recording.records import Recording
from h3data.recording.storage import AnyPath, RemotePath, place
from h3data.render.light.sources import LightMode
from h3data.terminal import counted
from h3data_exporters.transitions import SUCCESS_EVENTS, transitions_of

VideosOf = Callable[[int, Recording], AbstractContextManager[Sequence[EpisodeVideo]]]
"""Function that returns a context manager of an episode's videos, by number. They have all steps but the last, and
their files may be deleted at the end of the block."""


def write_lerobot(
    recordings: Iterable[Recording],
    root: str | Path | RemotePath,
    *,
    agent: str | None = None,
    overwrite: bool = False,
    videos_of: VideosOf | None = None,
    light: LightMode = "baked",
) -> int:
    """Write a dataset of transitions (`transitions_of`) to a folder and return the number of episodes.

    The columns of the recording are unchanged (h3data docs format), except that ``sim.*`` and ``state_hash`` are
    omitted, because LeRobot's loader fails on unsigned 64-bit numbers. In addition, each frame has
    ``observation.state`` (the agent's base pose, joints, ...), ``action`` (its action in that state), ``next.reward``,
    ``next.done`` and ``next.success``. The last row of each episode, which no action follows, is omitted; its events
    belong to the frame before, and skills end there. ``meta/h3data.json`` describes the observations that an
    environment must give to a policy trained on the dataset (`Demonstrations`). ``light`` is the light of videos whose
    recordings do not state it. ``recordings`` must be a list, not a generator, because they are read twice.

    Raises:
        InputError: there is no recording, one has no actions, or it does not fit the dataset.
    """
    first = next(iter(recordings), None)
    if first is None:
        raise InputError("There is no recording to write.", code="H3-EXPORT-027")
    fps = round(1e9 / _with_transitions(first, agent).episode.dt_ns)  # refused before a folder is made
    # a generator: one recording in memory at a time
    widest = (_with_transitions(recording, agent) for recording in recordings)
    summary: _Summary | None = None
    with DatasetWriter(root, fps=fps, overwrite=overwrite, like=widest) as out:
        for number, recording in enumerate(recordings):
            with videos_of(number, recording) if videos_of else nullcontext(()) as videos:
                out.add(_with_transitions(recording, agent), videos=videos)
                if summary is None:
                    summary = _Summary(recording, agent, [video.feature for video in videos], fps=fps, light=light)
            summary.add(recording)
        count = len(out)
    assert summary is not None
    write_demonstrations(place(root), summary.demonstrations())
    return count


def export_lerobot(recordings: Iterable[Recording], request: ExportRequest) -> Exported:
    """Export recordings for ``h3data export --to lerobot``."""
    cameras = tuple(dict.fromkeys(request.cameras or request.stored_cameras))
    counts = {"copied": 0, "rendered": 0}
    # where recordings do not name it: videos of older datasets are flat, and what is added to them has to match
    light: LightMode = "flat" if request.stored_cameras else "baked"

    @contextmanager
    def videos_of(number: int, recording: Recording) -> Iterator[Sequence[EpisodeVideo]]:
        frames = len(recording) - 1
        # the last frame, which a copy leaves out, stays in its statistics
        stored = {video.feature.camera: replace(video, length=frames) for video in request.stored_videos(number)}
        wanted = [camera for camera in cameras if camera not in stored]
        with TemporaryDirectory(prefix="h3data-") as folder:
            rendered: Iterator[EpisodeVideo] = iter(())
            if wanted:
                # at first use: videos that are only copied need no renderer
                from h3data.replay.camera_videos import render_videos

                rendered = iter(
                    render_videos(
                        recording,
                        wanted,
                        Path(folder),
                        steps=frames,
                        threads=request.threads,
                        assets=request.assets,
                        stand_ins=request.stand_ins,
                        light=recording.episode.info.get("light", light),
                        backend=request.backend,
                        progress=lambda items, total: request.progress(items, total, "frame"),
                    )
                )
            yield [stored[camera] if camera in stored else next(rendered) for camera in cameras]
        counts["rendered"] += len(wanted)
        counts["copied"] += len(cameras) - len(wanted)

    with _appearing_whole(place(request.out)) as root:
        count = write_lerobot(
            recordings, root, agent=request.agent, videos_of=videos_of if cameras else None, light=light
        )
    text = f"{request.out}: {counted(count, 'episode')} as a LeRobot v3.0 dataset"
    if cameras:
        text += f", with videos of {', '.join(cameras)} ({counts['rendered']} rendered, {counts['copied']} copied)"
    return Exported(text=text, data={"episodes": count, "cameras": list(cameras), "videos": counts})


@contextmanager
def _appearing_whole(root: AnyPath) -> Iterator[AnyPath]:
    """Yield a folder for a dataset that gets the name ``root`` at the end of the block and is deleted on an exception.

    In an object store, which cannot rename, it is ``root`` itself.
    """
    if isinstance(root, RemotePath):
        yield root
        return
    if root.exists() and (not root.is_dir() or any(root.iterdir())):
        raise InputError(
            f"The output folder exists and is not empty. Use force=True to overwrite it, or another name: {root}",
            code="H3-EXPORT-028",
        )
    # beside it, so that the rename stays within one disk
    part = root.with_name(f"{root.name}.part")
    shutil.rmtree(part, ignore_errors=True)  # of a run that was killed
    try:
        yield part
        part.replace(root)
    except BaseException as error:
        shutil.rmtree(part, ignore_errors=True)
        if isinstance(error, InputError) and isinstance(error.__cause__, OSError):
            why = error.__cause__.strerror or error.__cause__
            raise InputError(
                f"Could not write the dataset ({why}); nothing of it is kept: {root}", code="H3-EXPORT-029"
            ) from error
        raise


class _Summary:
    """Contents of ``meta/h3data.json``, gathered episode by episode."""

    def __init__(
        self, recording: Recording, agent: str | None, features: Sequence[VideoFeature], *, fps: int, light: LightMode
    ) -> None:
        self._first, self._agent, self._features, self._fps, self._light = recording, agent, tuple(features), fps, light
        self._scenes: dict[str, DemonstratedScene] = {}
        self._seeds: list[int] = []
        self._places: list[int] = []

    def add(self, recording: Recording) -> None:
        """Take down where an episode was played, and from which seed."""
        episode = recording.episode
        digest = str(episode.info.get("scene_sha256", ""))
        source = episode.info.get("scene_source")
        scene = DemonstratedScene(
            name=episode.scene,
            sha256=digest,
            episode=len(self._seeds),
            source=source if isinstance(source, dict) else {},
        )
        # recordings of others have no digest of their home
        key = digest or episode.scene
        self._scenes.setdefault(key, scene)
        self._places.append(list(self._scenes).index(key))
        self._seeds.append(episode.seed)

    def demonstrations(self) -> Demonstrations:
        """Return all of it."""
        recording = self._first
        info, found = recording.episode.info, transitions_of(recording, agent=self._agent)
        moved_by = {"robot": str(info.get("policy", "")), "human": str(info.get("partner", ""))}
        policies = {kind: names.split(",") if names else [] for kind, names in moved_by.items()}
        agents = []
        for who in recording.agents:
            named, number = policies.get(who.kind, []), sum(other.kind == who.kind for other in agents)
            # one name for several agents of a kind means all of them
            policy = named[min(number, len(named) - 1)] if named else ""
            agents.append(DemonstratedAgent(name=who.name, kind=who.kind, model=who.model, policy=policy))
        return Demonstrations(
            created_by=recording.episode.created_by,
            task=str(info.get("task") or recording.episode.task),
            instruction=str(info.get("instruction", "")),
            agent=recording.agents[found.agent].name,
            agents=tuple(agents),
            fps=self._fps,
            light=str(info.get("light", self._light)),
            state_columns=tuple(f"agent_{found.agent}.{name}" for name in found.state),
            state_names=found.state_names,
            action_names=found.action_names,
            success_events=SUCCESS_EVENTS,
            cameras=_cameras_of(recording, self._features),
            scenes=tuple(self._scenes.values()),
            seeds=tuple(self._seeds),
            episode_scenes=tuple(self._places),
            rules=info["spec"] if isinstance(info.get("spec"), dict) else {},
        )


def _cameras_of(recording: Recording, features: Sequence[VideoFeature]) -> tuple[DemonstratedCamera, ...]:
    """Return the lens and carrier of the cameras of some videos."""
    if not features:
        return ()
    from h3data.replay import Replay
    from h3data.replay.cameras import camera_names, camera_track, carrier_of

    replay = Replay(recording, stand_ins=True, light="flat")
    known = camera_names(replay)
    cameras = []
    for feature in features:
        # the feature ``agent.camera`` may be of a camera ``agent/camera`` that no replay lists
        owned = (
            f"{agent.name}/{feature.camera.removeprefix(f'{agent.name}.')}"
            for agent in recording.agents
            if feature.camera.startswith(f"{agent.name}.")
        )
        names = (name for name in (*known, *owned) if name.replace("/", ".") == feature.camera)
        name = next(names, "")
        carrier = carrier_of(replay, name) if name else None
        size, hfov_deg = (feature.width, feature.height), 0.0
        if carrier is not None:
            camera = camera_track(replay, name).camera
            hfov_deg = camera.hfov_deg
            # videos of the camera's own size, of which the last column or row may be a copy
            if (camera.width + camera.width % 2, camera.height + camera.height % 2) == size:
                size = camera.width, camera.height
        cameras.append(
            DemonstratedCamera(
                key=feature.key,
                camera=name.rpartition("/")[2] if carrier is not None else feature.camera,
                agent="" if carrier is None else recording.agents[carrier].name,
                width=size[0],
                height=size[1],
                stored_width=feature.width,
                stored_height=feature.height,
                hfov_deg=hfov_deg,
            )
        )
    return tuple(cameras)


def _with_transitions(recording: Recording, agent: str | None) -> Recording:
    found = transitions_of(recording, agent=agent)
    steps = len(found)
    done = np.zeros(steps, np.bool_)
    # the last frame is the end, whatever ended the episode
    done[-1] = True
    extra = {
        "observation.state": found.flat_state[:-1],
        "action": found.action,
        "next.reward": found.reward,
        "next.done": done,
        "next.success": found.reward > 0,
    }
    names = {"observation.state": list(found.state_names), "action": list(found.action_names)}
    columns = {
        name: values[:-1]
        # LeRobot's loader fails on unsigned 64-bit numbers
        for name, values in recording.columns.items()
        if values.dtype != np.uint64 and not name.startswith("sim.")
    }
    info = {**recording.episode.info, "lerobot": {"agent": recording.agents[found.agent].name, "names": names}}
    last = steps - 1
    return replace(
        recording,
        episode=replace(recording.episode, info=info),
        columns={**columns, **extra},
        # what happens in the row that is left out counts for the frame whose action led there, as its reward does
        events=tuple(replace(event, step=min(event.step, last)) for event in recording.events),
        skills=tuple(
            replace(span, end_step=min(span.end_step, last)) for span in recording.skills if span.start_step <= last
        ),
    )
