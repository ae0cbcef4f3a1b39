"""A cloud of wavebatch as COPC, by copclib: python to_copc.py CLOUD.laz X.copc.laz [POINTS_OF_A_NODE].

Keeps points, columns with units and no-data, and the CRS. The whole cloud is in memory: for some 50 million points.
"""

import sys

import copclib
import laspy
import numpy as np

source, target = sys.argv[1:3]
most = int(sys.argv[3]) if len(sys.argv) > 3 else 50_000
cloud = laspy.read(source)
records, crs = cloud.points.array, cloud.header.vlrs.get("WktCoordinateSystemVlr")
config = copclib.LazReader(source).laz_config  # units and no-data of the columns
old = config.las_header
how = copclib.CopcConfigWriter(
    old.point_format_id, old.scale, old.offset, crs[0].string if crs else "", config.extra_bytes_vlr
)
place = np.stack([cloud.x, cloud.y, cloud.z], axis=1)
low, side = place.min(axis=0), float(np.ptp(place, axis=0).max()) or 1.0
new = how.las_header
new.min, new.max = old.min, old.max
new.points_by_return, new.global_encoding = old.points_by_return, old.global_encoding
info = how.copc_info
info.center_x, info.center_y, info.center_z = low + side / 2
info.halfsize, info.spacing = side / 2, side / 128

# Each level of the octree has a random third of what the next one has.
last = max(0, int(np.ceil(np.log(len(records) / most) / np.log(4))))
level = last - np.minimum(np.random.default_rng(1).geometric(0.75, len(records)) - 1, last)
cells = [np.minimum((place - low) / side * 2**depth, 2**depth - 1).astype(int) for depth in range(last + 1)]
for depth in range(last):  # readers look for a node below a node that is there only
    deeper = np.flatnonzero(level > depth)
    level[deeper[np.unique(cells[depth][deeper], axis=0, return_index=True)[1]]] = depth

writer = copclib.FileWriter(target, how)
for depth in range(last + 1):
    mine = np.flatnonzero(level == depth)
    keys, node = np.unique(cells[depth][mine], axis=0, return_inverse=True)
    for number, key in enumerate(keys.tolist()):
        data = records[mine[node.ravel() == number]].tobytes()
        writer.AddNode(copclib.VoxelKey(depth, *key), copclib.VectorChar(np.frombuffer(data, np.int8)))
writer.Close()
