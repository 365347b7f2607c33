"""Differentiable rasterisation of 3D Gaussians: native CPU kernels, gsplat on CUDA, a torch reference."""

from extrags.raster.adam import SelectiveAdam as SelectiveAdam
from extrags.raster.dispatch import available_backends as available_backends
from extrags.raster.dispatch import rasterize as rasterize
from extrags.raster.light import CameraLight as CameraLight
from extrags.raster.loss import l1_ssim_loss as l1_ssim_loss
from extrags.raster.native import native_isa as native_isa
from extrags.raster.native import set_num_threads as set_num_threads
from extrags.raster.rendering import Rendering as Rendering
from extrags.raster.spherical_harmonics import sh_basis as sh_basis
