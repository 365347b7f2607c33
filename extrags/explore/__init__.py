"""Exploration: virtual trajectories that see what the recording did not."""

from extrags.explore.coverage import coverage_gain as coverage_gain
from extrags.explore.coverage import direction_bin as direction_bin
from extrags.explore.coverage import direction_counts as direction_counts
from extrags.explore.coverage import training_coverage as training_coverage
from extrags.explore.exploration import Exploration as Exploration
from extrags.explore.exploration import explore as explore
from extrags.explore.exploration import finish as finish
from extrags.explore.exploration import grow as grow
from extrags.explore.exploration import start_exploration as start_exploration
from extrags.explore.search import Branch as Branch
from extrags.explore.search import SearchContext as SearchContext
from extrags.explore.search import grow_branch as grow_branch
from extrags.explore.search import prepare_search as prepare_search
from extrags.explore.waves import WaveState as WaveState
from extrags.explore.waves import merge_wave as merge_wave
from extrags.explore.waves import start_views as start_views
