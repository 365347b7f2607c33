"""Looking at a scene live: pictures of a moving camera, light to be changed, paths to be recorded.

Nothing here knows a server or a window. A `ViewSession` is told where its viewer looks and says what to show:
half resolution while anything changes, full resolution once it rests.
"""

from __future__ import annotations

from extrags.view.recording import PathRecorder as PathRecorder
from extrags.view.renderer import LAYERS as LAYERS
from extrags.view.renderer import SceneRenderer as SceneRenderer
from extrags.view.renderer import ViewSettings as ViewSettings
from extrags.view.session import Picture as Picture
from extrags.view.session import RateMeter as RateMeter
from extrags.view.session import ViewSession as ViewSession
from extrags.view.viewpoints import overview as overview
from extrags.view.viewpoints import pinhole as pinhole
from extrags.view.viewpoints import typical_depth as typical_depth

__all__ = [
    "LAYERS",
    "PathRecorder",
    "Picture",
    "RateMeter",
    "SceneRenderer",
    "ViewSession",
    "ViewSettings",
    "overview",
    "pinhole",
    "typical_depth",
]
