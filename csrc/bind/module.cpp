// The compiled module linprim_geo._core: bindings of all parts, thread count, instruction set, speed limits,
// statistics.
#include <nanobind/stl/string.h>

#include <string>

#include "base/parallel.h"
#include "bind/parts.h"
#include "linprim.h"

namespace nb = nanobind;

NB_MODULE(_core, m) {
  bind_raster(m);
  bind_loss(m);
  bind_surface(m);
  bind_stereo(m);
  m.def("set_threads", &linprim::set_threads);
  m.def("threads", &linprim::threads);
  m.def("set_instruction_set", [](const std::string& name) { return linprim::set_instruction_set(name.c_str()); });
  m.def("instruction_set", [] { return std::string(linprim::instruction_set()); });
  m.def("limits", [] {
    linprim::Limits limits;
    {
      nb::gil_scoped_release release;
      limits = linprim::measure_limits();
    }
    nb::dict d;
    d["fma_gflops"] = limits.fma_gflops, d["exp_ns"] = limits.exp_ns;
    d["pair_forward_ns"] = limits.pair_forward_ns, d["pair_backward_ns"] = limits.pair_backward_ns;
    return d;
  });
  m.def("statistics", [] {
    const linprim::Statistics s = linprim::statistics();
    nb::dict d;
    d["primitives"] = s.primitives, d["visible"] = s.visible, d["pairs"] = s.pairs;
    d["visited_lanes"] = s.visited_lanes, d["hit_lanes"] = s.hit_lanes, d["working_set_bytes"] = s.working_set_bytes;
    d["project_ms"] = s.project_ms, d["sort_ms"] = s.sort_ms, d["bin_ms"] = s.bin_ms, d["forward_ms"] = s.forward_ms;
    d["backward_ms"] = s.backward_ms, d["project_backward_ms"] = s.project_backward_ms;
    return d;
  });
}
