"""A job for `extrags.poses.job.run_job` that says who it is and never ends by itself."""

from __future__ import annotations

import os
import time
from pathlib import Path

from extrags.poses.job import end_with_parent

if __name__ == "__main__":
    end_with_parent()
    Path(os.environ["EXTRAGS_TEST_PROCESS"]).write_text(f"{os.getpid()}\n")
    time.sleep(99)
