"""Devices on which tests run."""

import torch

from twin.warp_runtime import wp

DEVICES = ("cpu", "cuda") if torch.cuda.is_available() and wp.is_cuda_available() else ("cpu",)
