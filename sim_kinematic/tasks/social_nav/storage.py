"""Episodes of social navigation in files."""

from __future__ import annotations

from h3data.habitat.episodes.rearrange_episode import RearrangeEpisode as FileEntry
from h3data.habitat.episodes.social_nav_episodes import SocialNavEpisode, read_social_nav, social_nav_episode
from sim_kinematic.motion.spec import SocialNavSpec
from sim_kinematic.tasks.episode import Episode
from sim_kinematic.tasks.social_nav.episode import episode_from, rules_of, stored_episode
from sim_kinematic.tasks.storage import EpisodePlace, EpisodeStorage


class SocialNavStorage(EpisodeStorage[SocialNavEpisode]):
    """Stores starts and the person's goals."""

    def record(self, episode: Episode) -> SocialNavEpisode:
        return stored_episode(episode)

    def entry(
        self, record: SocialNavEpisode, *, episode_id: str, scene_id: str, scene_dataset_config: str = "default"
    ) -> FileEntry:
        return social_nav_episode(
            record, episode_id=episode_id, scene_id=scene_id, scene_dataset_config=scene_dataset_config
        )

    def read(self, entry: FileEntry, *, seed: int) -> SocialNavEpisode | None:
        del seed
        return read_social_nav(entry)

    def rules(self, record: SocialNavEpisode) -> SocialNavSpec:
        return rules_of(record)

    def episode(self, record: SocialNavEpisode, place: EpisodePlace) -> Episode:
        return episode_from(record, place.scene, spec=place.spec, free=place.free, human=place.human, robot=place.robot)
