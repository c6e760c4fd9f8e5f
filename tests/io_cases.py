"""Rows of every text format, records, and files that hold them, for the tests of readers and writers."""

import gzip

import torch

from torchspline.io import ImuRecord, PoseRecord

STAMP = 1520530308189679351  # a float64 is off by 55 ns here
TUM_ROW = "1.5 1 2 3 0 0 0.6 0.8"
EUROC_ROW = f"{STAMP},1,2,3,0.8,0,0,0.6"
IMU_ROW = f"{STAMP},1,2,3,4,5,6"
KITTI_ROW = "0 -1 0 1 1 0 0 2 0 0 1 3"


def poses(stamps, seed=0):
    generator = torch.Generator().manual_seed(seed)
    shape = {"dtype": torch.float64, "generator": generator}
    count = len(stamps)
    return PoseRecord(
        torch.tensor(stamps), 1e3 * torch.randn(count, 3, **shape), torch.randn(count, 4, **shape)
    )


def imu(stamps):
    record = poses(stamps, seed=1)
    return ImuRecord(record.time_ns, record.position, record.rotation[:, :3].contiguous())


def put(folder, content, name="file.txt"):
    path = folder / name
    data = content.encode() if isinstance(content, str) else content
    path.write_bytes(gzip.compress(data) if name.endswith(".gz") else data)
    return path
