"""How good inputs are damaged, and what has to be said of each: the file, the frame and the field."""

from __future__ import annotations

import numpy as np

from extrags.cameras import invert_poses
from tests.data_catalog.damage import (
    OPENGL,
    Damage,
    bigger,
    cut,
    depth,
    edited,
    emptied,
    every_frame,
    far_away,
    framed,
    image,
    intrinsics,
    inverted,
    line,
    llff,
    model,
    nan_at_four,
    no_video,
    out_of_order,
    panorama,
    posed,
    removed,
    same_image,
    telling_nothing,
    unknown_camera_model,
    with_negative,
    without_flip,
    words,
)

SPARSE = "sparse/0/"
DAMAGES = {
    # extrags' own folder
    "a frame is missing": Damage(
        "extrags", removed("rgb/0004.png"), "there is no such file", "rgb/0004.png", "file", "rgb/0004.png"
    ),
    "a pose is missing": Damage(
        "extrags",
        edited("poses.json", lambda content: content["frames"].pop(6)),
        "9 poses for 10 images in rgb/: this image has none",
        "rgb/0006.png",
        "world_from_camera",
        "poses.json",
    ),
    "a mirrored rotation": Damage(
        "extrags",
        posed(lambda pose: pose @ np.diag([-1.0, 1, 1, 1])),
        r"the rotation is mirrored \(det = -1.000\); expected det = \+1",
        "rgb/0003.png",
        "world_from_camera",
    ),
    "a transposed pose": Damage(
        "extrags",
        posed(lambda pose: pose.T),
        "The matrix looks transposed",
        "rgb/0003.png",
        "world_from_camera",
    ),
    "a pose with NaN": Damage(
        "extrags",
        posed(lambda pose: pose * np.where(np.eye(4)[0] > 0, np.nan, 1)),
        "of 16 entries are NaN or infinite",
        "rgb/0003.png",
        "world_from_camera",
    ),
    "a scaled rotation": Damage(
        "extrags",
        posed(lambda pose: pose * np.array([[1.2], [1.2], [1.2], [1]])),
        "not a rotation: singular values",
        "rgb/0003.png",
        "world_from_camera",
    ),
    "OpenGL axes": Damage(
        "extrags",
        posed(lambda pose: pose @ OPENGL, None),
        r"the poses contradict the depth.*read as OpenGL axes \(y up, z backward",
        None,
        "world_from_camera",
    ),
    "camera from world": Damage(
        "extrags",
        posed(lambda pose: invert_poses(pose[None])[0], None),
        r"read as world-to-camera \(inverted\)",
        None,
        "world_from_camera",
    ),
    "OpenGL axes without depth to tell": Damage(
        "bare",
        posed(lambda pose: pose @ OPENGL, None),
        r"the poses explain \d+% of \d+ feature matches.*when they are read as OpenGL axes",
        None,
        "world_from_camera",
    ),
    "camera from world without depth to tell": Damage(
        "bare",
        posed(lambda pose: invert_poses(pose[None])[0], None),
        r"the poses explain \d+% of \d+ feature matches.*world-to-camera \(inverted\), OpenCV axes",
        None,
        "world_from_camera",
    ),
    "poses of other frames": Damage(
        "bare",
        edited(
            "poses.json",
            lambda content: [
                entry.update(world_from_camera=pose)
                for entry, pose in zip(
                    content["frames"],
                    [content["frames"][k]["world_from_camera"] for k in (7, 2, 9, 0, 5, 8, 1, 4, 6, 3)],
                    strict=True,
                )
            ],
        ),
        "or frames and poses are not in the same order",
        None,
        "world_from_camera",
    ),
    "depth below zero": Damage(
        "extrags",
        depth(with_negative, (5,)),
        "3 of 7392 depth values are negative, the first at row 7, column 3",
        "rgb/0005.png",
        "depth_mm",
        "0005.npy",
    ),
    "depth in metres": Damage(
        "extrags",
        depth(lambda values: values / 1000),
        r"multiplied by about \d+, as of depth in metres beside poses in millimetres",
        None,
        "depth_mm",
    ),
    "depth codes not decoded": Damage(
        "extrags",
        depth(lambda values: values * 655.35),
        r"multiplied by about 0\.0015\d*, as of 16-bit codes of 0 to 100 mm that were not decoded",
        None,
        "depth_mm",
    ),
    "depth nowhere known": Damage(
        "extrags", depth(lambda values: values * 0), "no pixel of any frame has a depth", None, "depth_mm"
    ),
    "depth not known in a frame": Damage(
        "extrags", depth(lambda values: values * 0, (5,)), r"depth is known for 0\.0%", "0005", "depth_mm"
    ),
    "depth of another size": Damage(
        "extrags",
        depth(lambda values: values[::2, ::2], (5,)),
        "48 x 39 pixels; expected 96 x 77",
        "rgb/0005.png",
        "depth",
    ),
    "depth clipped": Damage(
        "extrags",
        depth(lambda values: np.minimum(values, 30)),
        r"of the known depths are exactly 30, the largest value.*Write 0 there",
        None,
        "depth_mm",
    ),
    "depth in 8 bits": Damage(
        "extrags",
        depth(lambda values: np.round(values / 5) * 5),
        "depth in steps of 5, .* expected finer values",
        None,
        "depth",
    ),
    "a depth file cut off": Damage(
        "extrags", cut("depth/0002.npy"), "cannot be read", "rgb/0002.png", "depth", "0002.npy"
    ),
    "zero focal length": Damage("extrags", intrinsics(fx=0), "focal length fx = 0 px", "rgb/0000.png", "K"),
    "K of twice the size": Damage(
        "bare",
        intrinsics(all=2),
        "is the centre of an image 2 times as large.*K belongs to another size",
        "0000",
        "K",
    ),
    "a squeezed K": Damage(
        "bare", intrinsics(fx=1.4), "pixels are nearly square in all endoscopes", "0000", "K"
    ),
    "principal point off": Damage(
        "bare",
        intrinsics(cx=0.2),
        "lies far from the centre of 96 x 77 pixels. Was the image cropped",
        "0000",
        "K",
    ),
    "a field of view too wide": Damage(
        "bare", intrinsics(fx=0.12, fy=0.12), r"means a field of view of 1\d\d degrees", "0000", "K"
    ),
    "an image cut off": Damage(
        "extrags", cut("rgb/0002.png"), "damaged or truncated image", "rgb/0002.png", "rgb", "0002.png"
    ),
    "a frame listed twice": Damage(
        "extrags",
        edited("poses.json", lambda content: content["frames"].append(content["frames"][1])),
        "the frame is listed twice",
        "rgb/0001.png",
        "file",
    ),
    "an inverted mask": Damage(
        "bare", framed, "the mask is inverted. Expected white on tissue", None, "mask"
    ),
    "an exposure jump": Damage(
        "bare",
        image(lambda values: values * 0.35, (5, 6, 7, 8, 9)),
        r"0\.3\d times as bright as the frame before \(1 such jumps",
        "0005",
        "rgb",
    ),
    "a black frame": Damage(
        "bare", image(lambda values: values * 0, (6,)), "1 of 10 frames are like that", "0006", "rgb"
    ),
    "blue for red": Damage(
        "bare",
        image(lambda values: values[..., ::-1], tuple(range(10))),
        "channels are probably swapped",
        None,
        "rgb",
    ),
    "the same image twice": Damage("bare", same_image, "the same image as frame 0004", "0005", "rgb"),
    "overexposed": Damage(
        "bare",
        image(lambda values: np.clip(values * 4.0, 0, 255), tuple(range(10))),
        "are saturated in some channel",
        None,
        "rgb",
    ),
    "frames out of order": Damage(
        "bare",
        edited("poses.json", out_of_order),
        "listed after 0005, though its name comes before",
        "0004",
        "frame names",
    ),
    "one pose off the path": Damage(
        "bare", posed(far_away, 5), "its pose is probably wrong", "0005", "world_from_camera"
    ),
    "all poses the same": Damage(
        "bare",
        posed(lambda _: np.eye(4), None),
        "all training frames have the same pose: the camera stands still, or the poses are placeholders",
        None,
        "world_from_camera",
    ),
    "hardly any parallax": Damage(
        "extrags",
        posed(lambda pose: pose * np.array([[1, 1, 1, 1e-4]] * 3 + [[1] * 4]), None),
        "Too little parallax to triangulate|different units",
        None,
    ),
    # COLMAP
    "images.bin cut off": Damage(
        "colmap", cut(SPARSE + "images.bin"), "the file ends inside", None, None, "images.bin"
    ),
    "no points3D.bin": Damage(
        "colmap",
        removed(SPARSE + "points3D.bin"),
        "no such file; a COLMAP model is",
        None,
        None,
        "points3D.bin",
    ),
    "most images of the model are missing": Damage(
        "colmap",
        lambda folder: [removed(f"images/{index:04d}.png")(folder) for index in range(3, 10)],
        r"images.bin lists 10 frames, and 7 of them are absent, this one first; at most 50% may be",
        "0003.png",
        "file",
        "0003.png",
    ),
    "an unknown camera model": Damage(
        "colmap",
        unknown_camera_model,
        "the camera model number 99 is not known here; known: SIMPLE_PINHOLE",
        "camera 1",
        "camera_model",
        "cameras.bin",
    ),
    "a panorama": Damage(
        "colmap",
        panorama,
        "the camera model EQUIRECTANGULAR is a panorama, which shows what lies behind",
        "camera 1",
        "camera_model",
        "cameras.bin",
    ),
    "COLMAP poses not inverted": Damage(
        "colmap", model(inverted), r"camera-to-world \(not inverted\), OpenCV axes", None, "world_from_camera"
    ),
    "COLMAP camera of another size": Damage(
        "text",
        line(SPARSE + "cameras.txt", 1, words({2: "192", 3: "154"})),
        "the image has 96 x 77 pixels, but cameras.txt describes a camera of 192 x 154; the intrinsics "
        "belong to images 2 times as large",
        "0000.png",
        "K",
    ),
    "a quaternion that is none": Damage(
        "text",
        line(SPARSE + "images.txt", 4, words({1: "2.5"})),
        r"quaternion of length 2\.\d+, expected 1",
        "0001.png",
        "orientation",
        "images.txt",
    ),
    "a broken line of cameras.txt": Damage(
        "text",
        line(SPARSE + "cameras.txt", 1, lambda _: "1 PINHOLE many few 1 1 1 1"),
        "line 2: expected CAMERA_ID MODEL WIDTH HEIGHT PARAMETERS",
        None,
        None,
        "cameras.txt",
    ),
    "an image without camera": Damage(
        "text",
        line(SPARSE + "images.txt", 4, words({8: "7"})),
        "refers to camera 7, which cameras.txt does not hold",
        "0001.png",
        "camera_id",
    ),
    "a held-out image without pose": Damage(
        "text",
        lambda folder: (folder / "test_list.txt").write_text("0001.png\n0077.png\n"),
        "1 of 2 held-out images have no pose in the model",
        "0077.png",
        "split",
        "test_list.txt",
    ),
    # transforms.json
    "transforms.json in OpenCV axes": Damage(
        "ngp",
        edited("transforms.json", without_flip),
        r"when they are read as OpenCV axes\. Expected OpenGL axes \(x right, y up, z backward\), camera to",
        None,
        "world_from_camera",
    ),
    "no focal length": Damage(
        "transforms",
        every_frame(lambda entry: [entry.pop("fl_x"), entry.pop("fl_y")]),
        r"no focal length; expected fl_x \(pixels\), camera_angle_x",
        "images/0000.png",
        "fl_x",
        "transforms.json",
    ),
    "a mask that is not there": Damage(
        "transforms",
        every_frame(lambda entry: entry.update(mask_path="masks/none.png")),
        "no such file",
        "images/0000.png",
        "mask_path",
        "none.png",
    ),
    "no JSON": Damage(
        "transforms", cut("transforms.json"), "not readable as JSON", None, None, "transforms.json"
    ),
    "a split that leaks": Damage(
        "transforms",
        edited("transforms.json", lambda content: content["train_filenames"].append("images/0000.png")),
        "1 frames both train and evaluate",
        "images/0000.png",
        "split",
    ),
    "depth without its factor": Damage(
        "transforms",
        edited("transforms.json", lambda content: content.update(depth_unit_scale_factor=1.0)),
        "depth and poses are in different units.*is multiplied by depth_unit_scale_factor, which is 0.001",
        None,
        "depth_mm",
    ),
    "an unknown lens": Damage(
        "transforms",
        edited("transforms.json", lambda content: content.update(camera_model="EQUIRECTANGULAR")),
        "camera_model 'EQUIRECTANGULAR' is not understood",
        "images/0000.png",
        "camera_model",
    ),
    # EndoNeRF
    "poses_bounds of another shape": Damage(
        "endonerf",
        llff(lambda rows: rows[:, :15]),
        r"found an array \(10, 15\) of float64; expected \[frames, 17\]",
        None,
        "poses",
        "poses_bounds.npy",
    ),
    "too few LLFF poses": Damage(
        "endonerf",
        llff(lambda rows: rows[:8]),
        "8 poses for 10 images",
        "frame-000008.png",
        "world_from_camera",
    ),
    "an LLFF pose with NaN": Damage(
        "endonerf", llff(nan_at_four), "1 of 17 numbers are NaN", "4", "world_from_camera", "poses_bounds.npy"
    ),
    "a mask too few": Damage(
        "endonerf", removed("masks/frame-000009.png"), "9 files for 10 images", "frame-000009.png", "mask"
    ),
    "masks of unknown polarity": Damage(
        "endonerf", telling_nothing, "what white means in the masks cannot be told", None, "mask", "masks"
    ),
    # plain frames and video
    "a frame of another size": Damage(
        "frames", bigger, "96 x 80 pixels; expected 96 x 77 as in the first frame", "2.png", "rgb", "2.png"
    ),
    "unusable intrinsics": Damage(
        "frames",
        lambda folder: (folder / "intrinsics.json").write_text('{"fx": 80}'),
        "expected K, or fx, fy, cx, cy, or field_of_view_deg",
        None,
        "K",
        "intrinsics.json",
    ),
    "an empty folder": Damage(
        "frames", emptied, "the folder is empty; expected images", None, None, "frames"
    ),
    "no video": Damage("frames", no_video, "cannot be opened as a video", None, None, "exam.mp4"),
}
