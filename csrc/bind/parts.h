// Parts of the Python module. Each checks shapes, releases the interpreter lock and calls the core; there is no
// arithmetic in them.
#pragma once

#include <nanobind/nanobind.h>

void bind_raster(nanobind::module_& m);
void bind_loss(nanobind::module_& m);
void bind_surface(nanobind::module_& m);
void bind_stereo(nanobind::module_& m);
