// Python arrays as the core expects them, and checks of their shapes.
#pragma once

#include <nanobind/nanobind.h>
#include <nanobind/ndarray.h>

#include <algorithm>
#include <cstdint>
#include <initializer_list>
#include <stdexcept>
#include <string>

namespace nb = nanobind;

template <class T>
using In = nb::ndarray<const T, nb::c_contig, nb::device::cpu>;
template <class T>
using Out = nb::ndarray<T, nb::c_contig, nb::device::cpu>;
using Pose = nb::ndarray<const double, nb::shape<3, 4>, nb::c_contig, nb::device::cpu>;

template <class Array>
auto checked(const Array& array, std::initializer_list<int64_t> shape, const char* name) {
  bool same = array.ndim() == shape.size();
  size_t axis = 0;
  for (int64_t size : shape) {
    if (same && int64_t(array.shape(axis)) != size) same = false;
    ++axis;
  }
  if (!same) {
    std::string wanted, found;
    for (int64_t size : shape) wanted += (wanted.empty() ? "" : ", ") + std::to_string(size);
    for (size_t a = 0; a < array.ndim(); ++a) found += (a ? ", " : "") + std::to_string(array.shape(a));
    throw std::invalid_argument(std::string(name) + " has shape (" + found + "), wanted (" + wanted + ")");
  }
  return array.data();
}

// Returns an array of `shape` that holds row indices into another array, called `of`; throws unless all lie from
// `least` to below `end`.
template <class T>
const T* rows_of(const In<T>& array, std::initializer_list<int64_t> shape, int64_t end, const char* name,
                 const char* of = "vertices", int64_t least = 0) {
  const T* rows = checked(array, shape, name);
  if (std::any_of(rows, rows + array.size(), [&](T row) { return row < least || row >= end; }))
    throw std::invalid_argument(std::string(name) + "s are outside of the " + of);
  return rows;
}
