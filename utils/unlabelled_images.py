"""Unlabelled RGB-D photographs of another domain: what a network can be adapted to.

A folder in Cornell's layout; whatever labels lie there are never opened. This module knows no
network and no simulator.
"""

from __future__ import annotations

from pathlib import Path

from utils.errors import UserError
from utils.image_files import open_image
from utils.real_data import (
    CORNELL_HINT,
    RealDataset,
    RealSample,
    Record,
    check_complete,
    existing_folder,
    group_files,
    read_rgbd,
)

KEY = "adaptation.target"  # the config key that names the folder
SIZE = (640, 480)  # pixels, of a first Kinect: nothing else in the folder tells the camera's scale
FEWEST = 5  # images: some are held out, and statistics of one or two mean nothing


class UnlabelledImages(RealDataset):
    """Pairs `NAMEr.png` (colour) and `NAMEd.tiff` (float32, metres from the robot's base as
    Cornell's are, see `utils.table_camera`) in any subfolder.

    Cornell's names `pcdNNNNr.png` are such names. Raises UserError, when it is opened, if there is
    no such folder, if a file of a pair is missing, if there are fewer than `FEWEST` images, or
    if one is not of `SIZE`. What the depths hold is for others to check (`models.target_images`).
    """

    def __init__(self, root: str | Path) -> None:
        root = existing_folder(root, KEY)
        files = group_files(root, r"(.+)(r\.png|d\.tiff)")
        if not files:
            raise UserError(
                f"{KEY} {root}: no images NAMEr.png with their depth NAMEd.tiff (float32, metres) "
                "found here or in subfolders"
            )
        check_complete(root, files, ("r.png", "d.tiff"), hint=CORNELL_HINT)
        if len(files) < FEWEST:
            raise UserError(
                f"{KEY} {root}: {len(files)} image{'s' * (len(files) > 1)}, expected at least "
                f"{FEWEST}; they stand for a whole domain, so give more"
            )
        for file in (pair["r.png"] for pair in files.values()):
            size = open_image(file).size
            if size != SIZE:
                raise UserError(
                    f"{KEY}: {file} is {size[0]} x {size[1]} px, expected {SIZE[0]} x {SIZE[1]} as "
                    "of Cornell's camera, whose scale is taken for granted"
                )
        super().__init__(root, [Record(name, name, pair) for name, pair in sorted(files.items())])

    def read(self, record: Record) -> RealSample:
        """An image without rectangles."""
        rgb, depth = read_rgbd(record.files["r.png"], record.files["d.tiff"])
        return RealSample(record.name, record.object_id, rgb, depth, positives=())
