"""Server of a study as a process, which ``h3data study run`` starts (see `h3data_play.serve`)."""

from __future__ import annotations

import sys
from typing import Any

from h3data_play.serve import ServeOptions, main
from h3data_studies.design import StudyPlan
from h3data_studies.front import StudyServer


class StudyServeOptions(ServeOptions, frozen=True, kw_only=True):
    """Options of the server of a study."""

    study: StudyPlan

    def front(self, **given: Any) -> StudyServer:
        """Return the server of the study."""
        return StudyServer(self.study, **given)


if __name__ == "__main__":
    sys.exit(main(StudyServeOptions))
