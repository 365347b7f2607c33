"""C3VD and C3VDv2: registered videos of silicone colons, read from the layouts they are published in.

* `published` knows every registered video and the split manifests (`videos.json`, `splits/*.json`).
* `video` reads one video's folder: names, poses, depth codes, calibration.
* `scaramuzza` is the fisheye's camera model, `pinhole` the way from it to an ideal pinhole.
* `coverage` is the mesh that comes with each video: alignment of recordings, and which surface was seen.
* `reader` puts these together as frames, `dataset` gives them their names in the catalogue.

Sources: Bobrow et al., "Colonoscopy 3D video dataset with paired depth from 2D-3D registration", Medical
Image Analysis 2023 (C3VD); Golhar et al., "C3VDv2 - Colonoscopy 3D video dataset with enhanced realism",
2025 (C3VDv2); licence of both: CC BY-NC-SA 4.0.
"""
