"""What is corrected of every sequence that was read, before any stage sees it."""

from __future__ import annotations

from extrags.blurred_depth_edges import without_blurred_depth_edges
from extrags.carried_depth import CarriedDepth
from extrags.config import IngestConfig
from extrags.depth_noise import with_clean_depth
from extrags.foreground_objects import without_foreground_objects
from extrags.measured_depth import as_given, with_depth_error
from extrags.rig_calibration import with_calibration_corrected
from extrags.scarce_depth import without_scarce_depth
from extrags.sequence import EndoscopicSequence
from extrags.switched_light import with_matched_light
from extrags.unusable_frames import without_blank_frames, without_misplaced_frames

__all__ = ["as_given", "with_corrections"]


def with_corrections(sequence: EndoscopicSequence, config: IngestConfig | None = None) -> EndoscopicSequence:
    """The sequence without unusable frames, its depth cleaned, brought into line with the poses, and judged.

    In this order, each with a warning where it changes anything: frames that show nothing are left out;
    frames of another light get the colours of the others; depth of few frames is left to the evaluation;
    speckles and noise of depth are taken out; what all frames have in common and is off is corrected; frames
    whose poses are grossly wrong are left out; objects in front of the surface are masked; depth between
    surfaces whose edges are blurred is taken to be unknown; and depth that frames disagree about is given an
    expected error. Of a sequence without poses the first two alone.

    Args:
        sequence: as its source has it.
        config: settings of reading; None takes their defaults.
    """
    config = IngestConfig() if config is None else config
    sequence = without_blank_frames(sequence)
    if config.match_light:
        sequence = with_matched_light(sequence)
    if sequence.world_from_camera is None:
        return sequence
    sequence = without_scarce_depth(sequence)
    if config.depth_error == "auto":
        sequence = with_clean_depth(sequence)
    carried = CarriedDepth.of(sequence)
    if config.correct_calibration:
        given, lens = sequence, config.calibration is None
        sequence = with_calibration_corrected(given, carried, lens=lens)
        carried = carried if sequence is given else CarriedDepth.of(sequence)
    given = sequence
    sequence = without_misplaced_frames(given, carried)
    carried = carried if sequence is given else CarriedDepth.of(sequence)
    if config.mask_foreground:
        given = sequence
        sequence = without_foreground_objects(given, carried)
        carried = carried if sequence is given else CarriedDepth.of(sequence)
    if config.depth_error == "auto":
        given = sequence
        sequence = without_blurred_depth_edges(given, carried)
        carried = carried if sequence is given else CarriedDepth.of(sequence)
    return with_depth_error(sequence, carried, config.depth_error)
