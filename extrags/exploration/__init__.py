"""Exploration: virtual trajectories that see what the recording did not."""

from extrags.exploration.coverage import coverage_gain as coverage_gain
from extrags.exploration.coverage import direction_bin as direction_bin
from extrags.exploration.coverage import direction_counts as direction_counts
from extrags.exploration.coverage import training_coverage as training_coverage
from extrags.exploration.measurements import SceneMeasurements as SceneMeasurements
from extrags.exploration.search import Branch as Branch
from extrags.exploration.search import SearchContext as SearchContext
from extrags.exploration.search import grow_branch as grow_branch
from extrags.exploration.search import prepare_search as prepare_search
from extrags.exploration.trajectories import Exploration as Exploration
from extrags.exploration.trajectories import explore as explore
from extrags.exploration.trajectories import finish as finish
from extrags.exploration.trajectories import grow as grow
from extrags.exploration.trajectories import start_exploration as start_exploration
from extrags.exploration.waves import WaveState as WaveState
from extrags.exploration.waves import merge_wave as merge_wave
from extrags.exploration.waves import start_views as start_views
