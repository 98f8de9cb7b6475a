// The parts of the module; each checks shapes, releases the interpreter lock, calls the core. No arithmetic in them.
#pragma once

#include <nanobind/nanobind.h>

void bind_raster(nanobind::module_& m);
void bind_loss(nanobind::module_& m);
void bind_surface(nanobind::module_& m);
void bind_stereo(nanobind::module_& m);
