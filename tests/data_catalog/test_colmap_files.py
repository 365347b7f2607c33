"""Files of a COLMAP model: what is written is what pycolmap reads, and damage is named."""

from __future__ import annotations

import json
import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from data_catalog.readers.colmap_files import (
    ColmapImage,
    ColmapModel,
    read_image_names,
    read_model,
    write_model,
)
from extrags.cameras import look_at
from extrags.errors import PoseError, SourceError
from extrags.lens import Lens


def model_of_three() -> ColmapModel:
    """Three images of one camera, without points."""
    images = [
        ColmapImage(
            name=f"{index:04d}.png",
            camera=1,
            world_from_camera=look_at(np.array([index, 1.0, 2.0]), np.zeros(3), up=np.array([0.0, 1, 0])),
            observed_px=np.zeros((0, 2)),
            observed_point=np.zeros(0, dtype=np.int64),
        )
        for index in range(3)
    ]
    lens = Lens("PINHOLE", (60.0, 61.0, 47.0, 39.5), 96, 77)
    return ColmapModel({1: lens}, images, np.zeros((0, 3)), np.zeros((0, 3), dtype=np.uint8))


@pytest.mark.parametrize("binary", [True, False])
class TestFiles:
    def test_an_image_listed_twice_is_refused(self, tmp_path: Path, binary: bool) -> None:
        model = model_of_three()
        images = [*model.images, model.images[1]]
        write_model(replace(model, images=images), tmp_path / "model", binary=binary)
        name = model.images[1].name
        with pytest.raises(
            SourceError, match=rf"images\.(bin|txt), frame {name}, field name: the image is listed twice"
        ):
            read_model(tmp_path / "model")

    def test_a_model_without_images_is_refused(self, tmp_path: Path, binary: bool) -> None:
        model = model_of_three()
        write_model(replace(model, images=[]), tmp_path / "model", binary=binary)
        with pytest.raises(SourceError, match=r"images\.(bin|txt): the model holds no registered image"):
            read_model(tmp_path / "model")

    def test_names_of_images_are_read_from_either_kind_of_file(self, tmp_path: Path, binary: bool) -> None:
        model = model_of_three()
        write_model(model, tmp_path / "model", binary=binary)
        assert read_image_names(tmp_path / "model") == [image.name for image in model.images]

    def test_tracks_of_points_follow_from_what_images_observe(self, tmp_path: Path, binary: bool) -> None:
        """As pycolmap reads them, in a process of its own."""
        model = model_of_three()
        points = np.array([[0.0, 0, 1], [0, 1, 2], [3, 0, 4]])
        observed: tuple[list[int], ...] = ([2, -1, 0], [0], [])
        images = [
            replace(
                image,
                observed_px=np.arange(2.0 * len(seen)).reshape(-1, 2) + 1,
                observed_point=np.array(seen, dtype=np.int64),
            )
            for image, seen in zip(model.images, observed, strict=True)
        ]
        colors = np.full((3, 3), 90, dtype=np.uint8)
        written = replace(model, images=images, points=points, points_rgb=colors)
        write_model(written, tmp_path / "model", binary=binary)
        found = read_model(tmp_path / "model")
        for image, seen in zip(found.images, observed, strict=True):
            assert image.observed_point.tolist() == seen
        code = (
            "import json, sys\n"
            "import PIL.Image, cv2, pycolmap\n"
            "model = pycolmap.Reconstruction(sys.argv[1])\n"
            "names = {number: image.name for number, image in model.images.items()}\n"
            "tracks = [\n"
            "    (p.xyz.tolist(), [(names[e.image_id], e.point2D_idx) for e in p.track.elements])\n"
            "    for p in model.points3D.values()\n"
            "]\n"
            "print(json.dumps(tracks))\n"
        )
        arguments = [sys.executable, "-c", code, str(tmp_path / "model")]
        said = json.loads(subprocess.run(arguments, capture_output=True, text=True, check=True).stdout)
        first, second = images[0].name, images[1].name
        assert sorted(said) == [
            [[0.0, 0.0, 1.0], [[first, 2], [second, 0]]],
            [[0.0, 1.0, 2.0], []],
            [[3.0, 0.0, 4.0], [[first, 0]]],
        ]


def text_model(folder: Path) -> Path:
    """One image that observes both of two points, in text."""
    model = model_of_three()
    image = replace(
        model.images[0], observed_px=np.array([[3.0, 4.0], [5.0, 6.0]]), observed_point=np.array([1, 0])
    )
    points = np.array([[0.0, 0, 1], [0, 1, 2]])
    colors = np.array([[0, 128, 255], [255, 0, 1]], dtype=np.uint8)
    write_model(replace(model, images=[image], points=points, points_rgb=colors), folder, binary=False)
    return folder


class TestText:
    def test_empty_lines_and_comments_are_passed_over(self, tmp_path: Path) -> None:
        folder = text_model(tmp_path / "model")
        expected = read_model(folder)
        for name in ("cameras", "points3D"):
            file = folder / f"{name}.txt"
            file.write_text("\n# of another program\n\n" + file.read_text() + "\n\n")
        found = read_model(folder)
        assert found.lenses == expected.lenses
        np.testing.assert_array_equal(found.points, [[0, 0, 1], [0, 1, 2]])
        np.testing.assert_array_equal(found.points_rgb, [[0, 128, 255], [255, 0, 1]])
        assert found.images[0].observed_point.tolist() == [1, 0]

    def test_empty_lines_between_images_are_passed_over(self, tmp_path: Path) -> None:
        """Of two lines of an image the second may be empty, and is no separator then."""
        model = model_of_three()
        write_model(model, tmp_path, binary=False)
        file = tmp_path / "images.txt"
        lines = [one for one in file.read_text().splitlines() if not one.startswith("#")]
        heads = [one for one in lines if one.strip()]
        assert len(heads) == 3
        for text in (
            "\n".join(f"{head}\n" for head in heads),
            "# of another program\n\n" + "\n\n\n".join(heads) + "\n\n\n",
            "\n \n\n" + "\n1 2 -1 3 4 -1\n\n".join(heads),
        ):
            file.write_text(text)
            found = read_model(tmp_path)
            assert [image.name for image in found.images] == [image.name for image in model.images]
            for image, expected in zip(found.images, model.images, strict=True):
                np.testing.assert_allclose(image.world_from_camera, expected.world_from_camera, atol=1e-9)

    @pytest.mark.parametrize(
        "line",
        [
            "7 0 0 1 1 2",
            "7 0 0",
            "7 0 0 one 1 2 3 0",
            "7 0 0 1 256 2 3 0",
            "7 0 0 1 -1 2 3 0",
            "-7 0 0 1 1 2 3 0",
            f"{2**63} 0 0 1 1 2 3 0",
        ],
    )
    def test_a_damaged_line_of_points_is_named(self, tmp_path: Path, line: str) -> None:
        folder = text_model(tmp_path / "model")
        file = folder / "points3D.txt"
        lines = [one for one in file.read_text().splitlines() if not one.startswith("#")]
        file.write_text("\n".join([*lines, line]) + "\n")
        with pytest.raises(SourceError, match=r"points3D\.txt.*line 3: expected POINT3D_ID X Y Z R G B"):
            read_model(folder)

    @pytest.mark.parametrize("kept", [0, 1])
    def test_points_of_another_model_are_refused(self, tmp_path: Path, kept: int) -> None:
        folder = text_model(tmp_path / "model")
        file = folder / "points3D.txt"
        lines = [one for one in file.read_text().splitlines() if not one.startswith("#")]
        file.write_text("\n".join(lines[:kept]) + "\n")
        with pytest.raises(SourceError, match="field point3D_id: observes a point that points3D does not"):
            read_model(folder)

    @pytest.mark.parametrize("value", ["nan", "inf"])
    def test_a_translation_that_is_not_finite_is_refused(self, tmp_path: Path, value: str) -> None:
        folder = text_model(tmp_path / "model")
        file = folder / "images.txt"
        lines = [one for one in file.read_text().splitlines() if not one.startswith("#")]
        words = lines[0].split()
        words[6] = value
        file.write_text("\n".join([" ".join(words), *lines[1:]]) + "\n")
        with pytest.raises(PoseError, match=r"field translation: the translation is .*three finite numbers"):
            read_model(folder)
