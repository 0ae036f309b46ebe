"""Episodes of social navigation in files."""

from __future__ import annotations

from h3data.recording.task_episodes.rearrange_episode import RearrangeEpisode as FileEntry
from h3data.recording.task_episodes.social_nav_episodes import SocialNavEpisode, read_social_nav, social_nav_episode
from sim_kinematic.motion.spec import SocialNavSpec
from sim_kinematic.tasks.episode import Episode
from sim_kinematic.tasks.social_nav.episode import episode_from, rules_of, stored_episode
from sim_kinematic.tasks.storage import EpisodePlace, EpisodeStorage


class SocialNavStorage(EpisodeStorage[SocialNavEpisode]):
    """Stores starts and the person's goals."""

    def record(self, episode: Episode) -> SocialNavEpisode:
        """Record of an episode: the starts of both agents, the person's goals and the rules."""
        return stored_episode(episode)

    def entry(
        self, record: SocialNavEpisode, *, episode_id: str, scene_id: str, scene_dataset_config: str = "default"
    ) -> FileEntry:
        """Entry of an episode file, in the form of Habitat's social navigation episodes."""
        return social_nav_episode(
            record, episode_id=episode_id, scene_id=scene_id, scene_dataset_config=scene_dataset_config
        )

    def read(self, entry: FileEntry, *, seed: int) -> SocialNavEpisode | None:
        """Record in an entry of a file; None if the entry belongs to another task."""
        del seed
        return read_social_nav(entry)

    def rules(self, record: SocialNavEpisode) -> SocialNavSpec:
        """Rules in a record."""
        return rules_of(record)

    def episode(self, record: SocialNavEpisode, place: EpisodePlace) -> Episode:
        """Episode of a record in an opened scene."""
        return episode_from(record, place.scene, spec=place.spec, free=place.free, human=place.human, robot=place.robot)
