// Bindings of the image loss and of the optimiser's steps.
#include <nanobind/stl/optional.h>
#include <nanobind/stl/tuple.h>
#include <nanobind/stl/vector.h>

#include <optional>
#include <stdexcept>
#include <tuple>
#include <vector>

#include "bind/arrays.h"
#include "bind/parts.h"
#include "linprim.h"

void bind_loss(nb::module_& m) {
  m.def("photometric_loss",
        [](In<float> image, In<float> target, std::optional<In<float>> weight, float dssim, Out<float> gradient) {
          if (image.ndim() != 3) throw std::invalid_argument("image has to have shape (3, H, W)");
          const int64_t height = int64_t(image.shape(1)), width = int64_t(image.shape(2));
          const float* a = checked(image, {3, height, width}, "image");
          const float* b = checked(target, {3, height, width}, "target");
          const float* w = weight ? checked(*weight, {height, width}, "weight") : nullptr;
          float* g = checked(gradient, {3, height, width}, "gradient");
          if (height < 1 || width < 1) throw std::invalid_argument("the image is empty");
          linprim::Photometric result;
          {
            nb::gil_scoped_release release;
            result = linprim::photometric_loss(a, b, w, int(width), int(height), dssim, g);
          }
          return std::make_tuple(result.loss, result.l1, result.ssim, result.mse);
        });
  m.def("adam_step", [](Out<float> value, In<float> gradient, Out<float> first, Out<float> second, float rate,
                        float beta1, float beta2, float epsilon, int64_t step) {
    const int64_t n = int64_t(value.size());
    if (int64_t(gradient.size()) != n || int64_t(first.size()) != n || int64_t(second.size()) != n)
      throw std::invalid_argument("value, gradient and moments differ in size");
    if (step < 1) throw std::invalid_argument("step counts from 1");
    float *v = value.data(), *m1 = first.data(), *m2 = second.data();
    const float* g = gradient.data();
    nb::gil_scoped_release release;
    linprim::adam_step(v, g, m1, m2, n, rate, beta1, beta2, epsilon, step);
  });
  m.def(
      "adam_rows", [](std::vector<Out<float>> values, std::vector<In<float>> gradients, std::vector<Out<float>> firsts,
                      std::vector<Out<float>> seconds, std::vector<float> rates, Out<int32_t> steps,
                      std::optional<In<uint8_t>> touched, float beta1, float beta2, float epsilon) {
        const size_t count = values.size();
        if (gradients.size() != count || firsts.size() != count || seconds.size() != count || rates.size() != count)
          throw std::invalid_argument("there have to be as many gradients, moments and rates as values");
        const int64_t n = int64_t(steps.size());
        if (touched && int64_t(touched->size()) != n) throw std::invalid_argument("touched and steps differ in size");
        if (!(beta1 >= 0 && beta1 < 1 && beta2 >= 0 && beta2 < 1))
          throw std::invalid_argument("beta1 and beta2 have to be in [0, 1)");
        std::vector<linprim::RowTensor> tensors;
        for (size_t i = 0; i < count; ++i) {
          const int64_t size = int64_t(values[i].size());
          if (int64_t(gradients[i].size()) != size || int64_t(firsts[i].size()) != size ||
              int64_t(seconds[i].size()) != size)
            throw std::invalid_argument("value, gradient and moments differ in size");
          if (n ? size % n != 0 : size != 0)
            throw std::invalid_argument("a value does not have as many rows as there are steps");
          tensors.push_back(
              {values[i].data(), firsts[i].data(), seconds[i].data(), gradients[i].data(), n ? size / n : 0, rates[i]});
        }
        int32_t* counts = steps.data();
        const uint8_t* rows = touched ? touched->data() : nullptr;
        nb::gil_scoped_release release;
        linprim::adam_rows(tensors.data(), int(count), n, rows, counts, beta1, beta2, epsilon);
      });
}
