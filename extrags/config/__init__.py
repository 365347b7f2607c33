"""Settings: one frozen pydantic model per stage, with a description of each field, and named profiles.

Every public name of the modules below is here: a new model is listed in its own `__all__` alone.
"""

from extrags.config.base import *  # noqa: F403
from extrags.config.baselines import *  # noqa: F403
from extrags.config.coarse import *  # noqa: F403
from extrags.config.continuation import *  # noqa: F403
from extrags.config.depth import *  # noqa: F403
from extrags.config.exploration import *  # noqa: F403
from extrags.config.finetuning import *  # noqa: F403
from extrags.config.imported import *  # noqa: F403
from extrags.config.poses import *  # noqa: F403
from extrags.config.profiles import *  # noqa: F403
from extrags.config.restorer import *  # noqa: F403
from extrags.config.stages import *  # noqa: F403
