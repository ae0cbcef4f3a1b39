"""Square tiles of clouds of wavebatch, with laspy: python tiles.py METRES FOLDER CLOUD.laz ...

FOLDER is new; FOLDER/X_Y.laz has the points of all clouds from (X, Y) on, in their order, with all columns and the
CRS. The clouds must have the same columns. A chunk of a cloud is in memory; each tile stays open until the end.
"""

import copy
import sys
from pathlib import Path

import laspy
import numpy as np

size, folder, clouds = int(sys.argv[1]), Path(sys.argv[2]), sys.argv[3:]
folder.mkdir(parents=True)
tiles: dict[str, laspy.LasWriter] = {}
for name in clouds:
    with laspy.open(name) as cloud:
        for points in cloud.chunk_iterator(1_000_000):
            corner = np.stack([points.x, points.y], axis=1) // size * size
            corners, tile = np.unique(corner.astype(int), axis=0, return_inverse=True)
            for number, (x, y) in enumerate(corners.tolist()):
                path = folder / f"{x}_{y}.laz"
                if path.name not in tiles:
                    tiles[path.name] = laspy.open(path, mode="w", header=copy.deepcopy(cloud.header))
                writer, mine = tiles[path.name], points[tile.ravel() == number]
                mine.change_scaling(writer.header.scales, writer.header.offsets)
                writer.write_points(mine)
for writer in tiles.values():
    writer.close()
