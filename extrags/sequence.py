"""A posed endoscopic sequence and its storage in zarr."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field, replace
from functools import cached_property
from pathlib import Path
from typing import Any, ClassVar, cast

import numpy as np
from jaxtyping import Bool, Float, Int, UInt8

from extrags.array_shapes import check_array, check_instance
from extrags.cameras import Cameras
from extrags.errors import ShapeError
from extrags.frame_quantiles import median_of_frames
from extrags.frame_stacks import frames_of, stacked
from extrags.lens import Undistortion, resized_depth
from extrags.provenance import (
    ARBITRARY_SCALE,
    SCALE_WORDS,
    IntrinsicsSource,
    PoseSource,
    ScaleSource,
    StereoCamera,
)
from extrags.radial_lens import VIRTUAL_FIELD_DEG, RadialLens
from extrags.splits import Split
from extrags.store.storable import Storable
from extrags.thresholds import RELIABLE_DEPTH_ERROR, SATURATED
from extrags.zarr_io import has_array, new_group, open_group, read_array, write_array, write_frames

__all__ = [
    "EndoscopicSequence",
    "IntrinsicsSource",
    "PoseSource",
    "ScaleSource",
    "Split",
    "StereoCamera",
    "saturated_mask",
]

_SQUARE = 0.01
"""Focal lengths across and down that differ by a smaller share are those of square pixels."""
ALL_OF_AREA = 0.999
"""A downscaled pixel is valid above this share of valid area; below one because of rounding."""
_STACKS = ("depth_mm", "withheld_depth_mm", "depth_error", "observed", "specular")
_ARRAYS = ("world_from_camera", "recording", "points", "points_rgb")


@dataclass(frozen=True)
class EndoscopicSequence(Storable):
    """Frames of one scene: colour images, with depth, poses and ground truth where they exist.

    Frames of all recordings of the scene are concatenated and share one world coordinate system.

    Args:
        name: `DATASET/SEQUENCE[@SETTING]`.
        rgb: colour images, uint8, [F, H, W, 3].
        K: intrinsics in pixels, [F, 3, 3].
        mask: validity mask, true where a pixel shows tissue (in the field of view, no overlay), [F, H, W].
        split: training and held-out frames.
        world_from_camera: poses, or None until the poses stage has found them.
        depth_mm: z-depth, 0 where unknown, [F, H, W]; millimetres when `metric`.
        recording: index of the recording each frame belongs to, [F].
        frame_names: one name per frame, for messages.
        metric: true when lengths are millimetres; false for an arbitrary scale.
        observed: for held-out frames, true where the surface at a pixel is visible in at least one training
            frame; false elsewhere. None where the source has no such ground truth.
        points: sparse point cloud of the source, [P, 3], or None.
        points_rgb: their colours, uint8, [P, 3], or None.
        truth: further ground truth of simulated sources, as JSON (light, exposure, ...).
        specular: true on specular highlights, [F, H, W]; they have no weight in training, but count in the
            evaluation of held-out frames like any other pixel. None where they were not detected.
        pose_source: origin of the poses; the reconstruction may refine them.
        intrinsics: origin of `K`; the poses stage estimates what was guessed.
        focal_std_px: standard deviation of an estimated focal length, in pixels; None where it was not.
        withheld_depth_mm: true z-depth that the evaluation alone may use, 0 where unknown, [F, H, W]; None
            where `depth_mm` is the truth. See `true_depth_mm`.
        scale_source: what the unit of length rests on; of no account where it is arbitrary.
        depth_error: expected relative error of `depth_mm`, [F, H, W], where it was estimated, or measured and
            frames disagree about it (`extrags.measured_depth`); None where it is taken as it is.
        lens: of all frames, where they are the original pixels of a wide lens; None for pinholes.
        stereo_camera: whose frames these are, of a stereo endoscope; None of a source with one camera.

    Raises:
        ShapeError: when sizes or types do not fit, or the split names frames that are not there.
    """

    stored_as: ClassVar[str] = "sequence"
    kept_when_loaded: ClassVar[bool] = True
    """A dozen stages read the same frames, and decoding those of a long recording takes a minute."""

    name: str
    rgb: UInt8[np.ndarray, "f h w 3"]
    K: Float[np.ndarray, "f 3 3"]
    mask: Bool[np.ndarray, "f h w"]
    split: Split
    world_from_camera: Float[np.ndarray, "f 4 4"] | None = None
    depth_mm: Float[np.ndarray, "f h w"] | None = None
    recording: Int[np.ndarray, "f"] | None = None
    frame_names: tuple[str, ...] = ()
    metric: bool = True
    observed: Bool[np.ndarray, "f h w"] | None = None
    points: Float[np.ndarray, "p 3"] | None = None
    points_rgb: UInt8[np.ndarray, "p 3"] | None = None
    truth: dict[str, Any] = field(default_factory=dict)
    specular: Bool[np.ndarray, "f h w"] | None = None
    pose_source: PoseSource = "given"
    intrinsics: IntrinsicsSource = "given"
    focal_std_px: float | None = None
    withheld_depth_mm: Float[np.ndarray, "f h w"] | None = None
    scale_source: ScaleSource = "source"
    depth_error: Float[np.ndarray, "f h w"] | None = None
    lens: RadialLens | None = None
    stereo_camera: StereoCamera | None = None

    def __post_init__(self) -> None:
        check_array(self.rgb, f"{self.name}: rgb", (None, None, None, 3), np.uint8)
        frames, height, width = self.rgb.shape[:3]
        images = (frames, height, width)
        for name, array, shape, kind in (
            ("mask", self.mask, images, np.bool_),
            ("K", self.K, (frames, 3, 3), np.floating),
            ("world_from_camera", self.world_from_camera, (frames, 4, 4), np.floating),
            ("depth_mm", self.depth_mm, images, np.floating),
            ("withheld_depth_mm", self.withheld_depth_mm, images, np.floating),
            ("depth_error", self.depth_error, images, np.floating),
            ("observed", self.observed, images, np.bool_),
            ("specular", self.specular, images, np.bool_),
            ("recording", self.recording, (frames,), np.integer),
        ):
            if array is not None or name in ("mask", "K"):
                check_array(array, f"{self.name}: {name}", shape, kind)
        check_instance(self.split, f"{self.name}: split", Split)
        for name, index in (("train", self.split.train), ("test", self.split.test)):
            if len(index) and not 0 <= int(np.min(index)) <= int(np.max(index)) < frames:
                raise ShapeError(
                    f"{self.name}: split.{name} has indices from {np.min(index)} to {np.max(index)}, "
                    f"there are {frames} frames"
                )
        if self.frame_names and len(self.frame_names) != frames:
            raise ShapeError(f"{self.name}: {len(self.frame_names)} frame names for {frames} frames")

    def __repr__(self) -> str:
        """What it holds, in a line: its arrays would fill pages."""
        depth = "no depth" if self.depth_mm is None else "depth of training frames"
        if self.depth_mm is not None and not self.training_depth_known:
            depth = "depth for the evaluation alone"
        elif self.depth_error is not None:
            depth = "depth with an expected error"
        poses = "no poses" if self.world_from_camera is None else f"poses {self.pose_source}"
        return (
            f"EndoscopicSequence({self.name!r}, {len(self)} frames of {self.width} x {self.height} px, "
            f"{len(self.train)} train and {len(self.test)} held out ({self.split.name}), {poses}, {depth}, "
            f"{self.scale_words}, {'pinhole' if self.lens is None else 'radial lens'})"
        )

    def __len__(self) -> int:
        return int(self.rgb.shape[0])

    @property
    def width(self) -> int:
        """Image width in pixels."""
        return int(self.rgb.shape[2])

    @property
    def height(self) -> int:
        """Image height in pixels."""
        return int(self.rgb.shape[1])

    @property
    def cameras(self) -> Cameras:
        """All frames as cameras.

        Raises:
            ShapeError: while the poses are unknown.
        """
        if self.world_from_camera is None:
            raise ShapeError(f"{self.name} has no poses yet; the poses stage finds them")
        return Cameras(self.K, self.world_from_camera, self.width, self.height, self.lens)

    @property
    def train(self) -> Int[np.ndarray, "n_train"]:
        """Indices of training frames."""
        return self.split.train

    @property
    def test(self) -> Int[np.ndarray, "n_test"]:
        """Indices of held-out frames."""
        return self.split.test

    @property
    def training_cameras(self) -> Cameras:
        """Cameras of the training frames.

        Raises:
            PoseError: as `cameras`.
        """
        return self.cameras[self.train]

    @property
    def training_masks(self) -> list[Bool[np.ndarray, "h w"]] | None:
        """Masks of the training frames, in the memory of `mask`; None where all their pixels show tissue."""
        masks = [self.mask[frame] for frame in self.train]
        return None if all(bool(mask.all()) for mask in masks) else masks

    @cached_property
    def training_depth_known(self) -> bool:
        """Whether any training frame has depth: held-out frames may have some for the evaluation alone."""
        return self.depth_mm is not None and any(bool((self.depth_mm[k] > 0).any()) for k in self.train)

    @cached_property
    def median_depth_error(self) -> float:
        """Expected relative error of the training frames' depth, in the median; 0 where it has none."""
        if self.depth_error is None:
            return 0.0
        errors = self.depth_error
        found = median_of_frames(lambda: (errors[frame][self.mask[frame]] for frame in self.train.tolist()))
        return 0.0 if found is None else float(found)

    @cached_property
    def true_depth_mm(self) -> Float[np.ndarray, "f h w"] | None:
        """True z-depth of all frames, for the evaluation alone; 0 where unknown, None where none is known.

        In the unit of the poses, as `depth_mm`, but of training frames as well where their depth was
        withheld. Depth that was estimated from images (`depth_error`) is no truth.
        """
        if self.withheld_depth_mm is None:
            return self.depth_mm if self.depth_error is None else None
        return self.withheld_depth_mm if any(bool((d > 0).any()) for d in self.withheld_depth_mm) else None

    @property
    def scale_words(self) -> str:
        """What lengths are, and what says so, for tables and reports."""
        return SCALE_WORDS[self.scale_source] if self.metric else ARBITRARY_SCALE

    def in_millimetres(self, mm_per_unit: float, source: ScaleSource) -> EndoscopicSequence:
        """A copy of a posed sequence with all lengths multiplied, which makes it metric.

        Args:
            mm_per_unit: length of one unit of the poses.
            source: what it rests on.

        Raises:
            ShapeError: while the poses are unknown.
        """
        poses = self.cameras.world_from_camera.copy()
        poses[:, :3, 3] *= mm_per_unit

        def longer(lengths: Any) -> Any:
            return None if lengths is None else (lengths * mm_per_unit).astype(lengths.dtype)

        return replace(
            self,
            world_from_camera=poses,
            depth_mm=longer(self.depth_mm),
            withheld_depth_mm=longer(self.withheld_depth_mm),
            points=longer(self.points),
            metric=True,
            scale_source=source,
        )

    def with_changed_depth(
        self, changed: Callable[[int, Float[np.ndarray, "h w"]], np.ndarray]
    ) -> EndoscopicSequence:
        """A copy with all depth changed frame by frame, that of the evaluation alike; 0, unknown, stays.

        Args:
            changed: takes the index of a frame and its depth [H, W], and returns the new depth.
        """

        def of_all(depth_mm: np.ndarray | None) -> np.ndarray | None:
            if depth_mm is None:
                return None
            pairs = enumerate(depth_mm)
            frames = (np.where(d > 0, changed(k, d), 0).astype(d.dtype) for k, d in pairs)
            return stacked(frames, len(depth_mm))

        depth_mm, withheld = of_all(self.depth_mm), of_all(self.withheld_depth_mm)
        return replace(self, depth_mm=depth_mm, withheld_depth_mm=withheld)

    def without_training_depth(self) -> EndoscopicSequence:
        """A copy whose training frames have no depth, so that only the evaluation knows any.

        Held-out frames keep theirs. Points go too, since a source with depth may have made them from it. A
        sequence without depth is returned as it is.
        """
        if self.depth_mm is None:
            return self
        shown = self.depth_mm.copy()
        shown[self.train] = 0
        true = self.depth_mm if self.withheld_depth_mm is None else self.withheld_depth_mm
        return replace(self, depth_mm=shown, withheld_depth_mm=true, points=None, points_rgb=None)

    def supervised_mask(self, frames: int | Int[np.ndarray, "n"]) -> Bool[np.ndarray, "*n h w"]:
        """Mask of pixels used for supervision: the validity mask without detected specular highlights.

        Args:
            frames: index of one frame, or indices of several.

        Returns:
            [H, W] for one frame, [N, H, W] for several; a copy.
        """
        mask = self.mask[frames]
        return np.array(mask) if self.specular is None else np.asarray(mask & ~self.specular[frames])

    def reliable_depth_mm(self, frames: int | Int[np.ndarray, "n"]) -> Float[np.ndarray, "*n h w"] | None:
        """Depth that stands for a seen surface: measured, or estimated with a small expected error.

        Args:
            frames: index of one frame, or indices of several.

        Returns:
            [H, W] for one frame, [N, H, W] for several; 0 outside the mask, where depth is unknown and where
            an estimate expects more than `RELIABLE_DEPTH_ERROR`. None where the sequence has no depth.
        """
        if self.depth_mm is None:
            return None
        reliable = np.array(self.mask[frames])
        if self.depth_error is not None:
            reliable &= self.depth_error[frames] <= RELIABLE_DEPTH_ERROR
        return np.where(reliable, self.depth_mm[frames], 0).astype(np.float32)

    def frame_name(self, index: int) -> str:
        """Name of a frame, for messages."""
        return self.frame_names[index] if self.frame_names else f"{index:04d}"

    def with_poses(
        self, world_from_camera: Float[np.ndarray, "f 4 4"], source: PoseSource = "given"
    ) -> EndoscopicSequence:
        """A copy of the sequence with other poses, `world_from_camera` [F, 4, 4]."""
        return replace(self, world_from_camera=world_from_camera, pose_source=source)

    def as_pinhole(self, field_of_view_deg: float = VIRTUAL_FIELD_DEG) -> EndoscopicSequence:
        """The same frames resampled to a centred pinhole of their size; those of a pinhole as they are.

        What works on image planes (virtual views and their references, stereo) is given these; the periphery
        of a wide lens does not fit. A pixel is valid where all source pixels round its centre are.

        Args:
            field_of_view_deg: horizontal, at most; less where the frames show less.
        """
        if self.lens is None:
            return self
        K, which = np.unique(self.K.reshape(len(self), 9), axis=0, return_inverse=True)
        plans = [
            Undistortion.of_radial(one.reshape(3, 3), self.lens, self.width, self.height, field_of_view_deg)
            for one in K
        ]
        plan = [plans[index] for index in which.reshape(-1)]

        def depths(stack: np.ndarray | None) -> np.ndarray | None:
            if stack is None:
                return None
            return stacked((p.depth(d) for p, d in zip(plan, stack, strict=True)), len(plan))

        def masks(stack: np.ndarray | None) -> np.ndarray | None:
            if stack is None:
                return None
            return stacked((p.mask(m) for p, m in zip(plan, stack, strict=True)), len(plan))

        specular = None if self.specular is None else masks(~self.specular)
        return replace(
            self,
            rgb=stacked((p.color(image) for p, image in zip(plan, self.rgb, strict=True)), len(plan)),
            K=np.stack([p.K for p in plan]),
            mask=cast("np.ndarray", masks(self.mask)),
            depth_mm=depths(self.depth_mm),
            withheld_depth_mm=depths(self.withheld_depth_mm),
            observed=masks(self.observed),
            specular=None if specular is None else ~specular,
            depth_error=depths(self.depth_error),
            lens=None,
        )

    def at_most_width(self, width: int) -> EndoscopicSequence:
        """The same frames, downscaled to this width in pixels if they are wider; the aspect ratio is kept.

        Colours are means over the area of a pixel. A pixel is valid where all of its area is; its depth is
        that at its centre, on one side of an edge, since a mean over it belongs to neither.
        """
        if self.width <= width:
            return self
        return self._resized((width, max(1, round(self.height * width / self.width))))

    def with_square_pixels(self) -> EndoscopicSequence:
        """The same frames, made lower or higher until both focal lengths agree; as in `at_most_width`.

        A sequence whose pixels are square, to a percent, is returned as it is. All frames must have one
        camera.
        """
        stretch = float(self.K[0, 1, 1] / self.K[0, 0, 0])
        if abs(stretch - 1) <= _SQUARE:
            return self
        return self._resized((self.width, max(1, round(self.height / stretch))))

    def _resized(self, size: tuple[int, int]) -> EndoscopicSequence:
        import cv2

        def resized(stack: np.ndarray, interpolation: int) -> np.ndarray:
            return stacked((cv2.resize(i, size, interpolation=interpolation) for i in stack), len(stack))

        def depths(stack: np.ndarray | None) -> np.ndarray | None:
            return None if stack is None else stacked((resized_depth(d, *size) for d in stack), len(stack))

        def where_share(stack: np.ndarray, above: float) -> np.ndarray:
            shares = (cv2.resize(i.astype(np.float32), size, interpolation=cv2.INTER_AREA) for i in stack)
            return stacked((share > above for share in shares), len(stack))

        K = self.K.copy()
        K[:, 0] *= size[0] / self.width
        K[:, 1] *= size[1] / self.height
        observed, specular, error = self.observed, self.specular, self.depth_error
        return replace(
            self,
            rgb=resized(self.rgb, cv2.INTER_AREA),
            K=K,
            mask=where_share(self.mask, ALL_OF_AREA),
            depth_mm=depths(self.depth_mm),
            withheld_depth_mm=depths(self.withheld_depth_mm),
            observed=None if observed is None else where_share(observed, ALL_OF_AREA),
            specular=None if specular is None else where_share(specular, 0.0),
            focal_std_px=None if self.focal_std_px is None else self.focal_std_px * size[0] / self.width,
            depth_error=None if error is None else resized(error, cv2.INTER_NEAREST_EXACT),
        )

    def training_part(self) -> EndoscopicSequence:
        """The training frames alone, without any information on the held-out frames.

        Reconstruction, exploration and restoration get this sequence only: held-out frames cannot leak into
        them, and settings with the same training frames share their cached results.
        """
        train = self.train

        def of_train(stack: Any) -> Any:
            return None if stack is None else frames_of(stack, train)

        recording = of_train(self.recording)
        return replace(
            self,
            name=self.name.split("@")[0],
            rgb=of_train(self.rgb),
            K=self.K[train],
            mask=of_train(self.mask),
            split=Split("training", np.arange(len(train)), np.arange(0), self.split.version),
            world_from_camera=of_train(self.world_from_camera),
            depth_mm=of_train(self.depth_mm) if self.training_depth_known else None,
            withheld_depth_mm=None,
            recording=None if recording is None else np.unique(recording, return_inverse=True)[1],
            frame_names=tuple(self.frame_name(int(frame)) for frame in train),
            observed=None,
            truth={},
            specular=of_train(self.specular),
            depth_error=of_train(self.depth_error),
        )

    def save(self, path: Path) -> None:
        """Write a zarr v3 group; one frame per chunk for image stacks."""
        with new_group(path) as group:
            write_frames(group, "rgb", self.rgb)
            write_frames(group, "mask", self.mask)
            write_array(group, "K", self.K)
            write_array(group, "split/train", self.split.train.astype(np.int64))
            write_array(group, "split/test", self.split.test.astype(np.int64))
            for name in _STACKS:
                stack = getattr(self, name)
                if stack is not None:
                    write_frames(group, name, stack)
            for name in _ARRAYS:
                array = getattr(self, name)
                if array is not None:
                    write_array(group, name, array)
            group.attrs.update(
                {
                    "name": self.name,
                    "metric": self.metric,
                    "frame_names": list(self.frame_names),
                    "split": {"name": self.split.name, "version": self.split.version},
                    "truth": self.truth,
                }
            )
            # Written only where it differs from the default, so that older artefacts keep their digest.
            facts = (
                ("pose_source", self.pose_source, "given"),
                ("intrinsics", self.intrinsics, "given"),
                ("focal_std_px", self.focal_std_px, None),
                ("lens", None if self.lens is None else self.lens.to_json(), None),
                ("scale_source", self.scale_source, "source"),
                ("stereo_camera", self.stereo_camera, None),
            )
            group.attrs.update({name: fact for name, fact, usual in facts if fact != usual})

    @classmethod
    def load(cls, path: Path) -> EndoscopicSequence:
        """Read what `save` wrote."""
        group = open_group(path)
        attributes = dict(group.attrs)
        split: Any = attributes["split"]
        optional = {
            name: read_array(group, name) if has_array(group, name) else None for name in (*_STACKS, *_ARRAYS)
        }
        truth: Any = attributes["truth"]
        lens: Any = attributes.get("lens")
        names: Any = attributes["frame_names"]
        return cls(
            name=str(attributes["name"]),
            rgb=read_array(group, "rgb"),
            K=read_array(group, "K"),
            mask=read_array(group, "mask"),
            split=Split(
                split["name"],
                read_array(group, "split/train"),
                read_array(group, "split/test"),
                split["version"],
            ),
            frame_names=tuple(names),
            metric=bool(attributes["metric"]),
            truth=truth,
            pose_source=cast("PoseSource", attributes.get("pose_source", "given")),
            intrinsics=cast("IntrinsicsSource", attributes.get("intrinsics", "given")),
            focal_std_px=cast("float | None", attributes.get("focal_std_px")),
            scale_source=cast("ScaleSource", attributes.get("scale_source", "source")),
            lens=None if lens is None else RadialLens.from_json(lens),
            stereo_camera=cast("StereoCamera | None", attributes.get("stereo_camera")),
            **optional,
        )


def saturated_mask(rgb: UInt8[np.ndarray, "*f h w 3"]) -> Bool[np.ndarray, "*f h w"]:
    """True where any channel is at or above `SATURATED`: the true radiance is unknown there."""
    # Several times as fast as a maximum over the last axis.
    red, green, blue = np.moveaxis(rgb >= SATURATED, -1, 0)
    return np.asarray(red | green | blue)
