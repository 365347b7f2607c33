"""The end of a command's process, without Python's clearing up of everything that was imported.

With torch, Open3D and Prefect loaded, Python takes more than a second to free thousands of modules one by
one, memory that the kernel takes back at once.
"""

from __future__ import annotations

import atexit
import logging
import os
import sys

__all__ = ["ProcessEnd"]


class ProcessEnd:
    """Ends the process as soon as all that others have registered for its exit is done.

    To be made before anything heavy is imported: exit handlers run in the reverse order of their
    registration, so that this one runs after those of Prefect, of its temporary server and of pools of
    workers. Threads that are no daemons have ended by then.
    """

    def __init__(self) -> None:
        self.code: int | None = None
        """Exit code of the process. Without one it ends as usual: an exception is on its way."""
        atexit.register(self._end)

    def _end(self) -> None:
        if self.code is None:
            return
        # Registered before this was, and needed: it closes the handlers.
        logging.shutdown()
        try:
            sys.stdout.flush()
            sys.stderr.flush()
        except (OSError, ValueError):
            # Nobody reads any more, or the stream is closed: Python reports that in its own way.
            return
        os._exit(self.code)
