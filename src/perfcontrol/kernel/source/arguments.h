// What the kernel is given: arrays with any leading axes of paths, of which each path sees its part.

#ifndef PERFCONTROL_ARGUMENTS_H_
#define PERFCONTROL_ARGUMENTS_H_

#include <array>
#include <cstddef>
#include <cstdint>
#include <vector>

#include "numbers.h"
#include "random.h"
#include "xla/ffi/api/ffi.h"

namespace perfcontrol {

// What the perturbations are drawn from, and the noise: that is kNone where it is given.
enum Source : int64_t { kNone = 0, kMatrices = 1, kSigns = 2, kUniform = 3, kProducts = 4, kNormal = 5 };

struct Sizes {
  size_t n, m, memory, horizon;
};

// `inner` axes belong to one path, the first of them time where `timed`: of length 0 (absent), 1 (the same at all
// times) or as many as there are times. An axis of paths of length one is shared.
struct Argument {
  const char* data;
  std::vector<size_t> strides;  // bytes, by axis of paths
  size_t step = 0;              // entries from one time to the next
  bool present;

  Argument(xla::ffi::AnyBuffer buffer, size_t inner, size_t width, bool timed)
      : data(static_cast<const char*>(buffer.untyped_data())) {
    const auto dims = buffer.dimensions();
    const size_t axes = dims.size() - inner;
    size_t size = 1;
    for (size_t axis = axes; axis < dims.size(); ++axis) size *= dims[axis];
    if (timed && dims[axes] > 1) step = size / dims[axes];
    present = size > 0;
    strides.resize(axes);
    size_t stride = size * width;
    for (size_t axis = axes; axis-- > 0; stride *= dims[axis]) strides[axis] = dims[axis] == 1 ? 0 : stride;
  }

  const char* Of(const std::vector<size_t>& path) const {
    const char* start = data;
    for (size_t axis = 0; axis < path.size(); ++axis) start += path[axis] * strides[axis];
    return start;
  }
};

template <size_t kLanes>
using Places = std::array<std::vector<size_t>, kLanes>;

// The parts of an argument that belong to the paths worked on together.
template <typename T, bool kTogether>
struct Series {
  using Number = typename Kind<T, kTogether>::Number;
  static constexpr size_t kLanes = Kind<T, kTogether>::kLanes;

  std::array<const T*, kLanes> data{};
  size_t step = 0;
  bool present, shared = true;

  Series(const Argument& argument, const Places<kLanes>& paths) : step(argument.step), present(argument.present) {
    if (!present) return;
    for (size_t lane = 0; lane < kLanes; ++lane) {
      data[lane] = reinterpret_cast<const T*>(argument.Of(paths[lane]));
      shared &= data[lane] == data[0];
    }
  }

  Number At(size_t t, size_t entry) const {
    if constexpr (kTogether) {
      Number number;
      for (size_t lane = 0; lane < kLanes; ++lane) number[lane] = data[lane][t * step + entry];
      return number;
    } else {
      return data[0][t * step + entry];
    }
  }
};

// In the order in which they come: axes of one path, and whether the first of them is time.
constexpr size_t kArguments = 21;
constexpr size_t kInner[kArguments] = {3, 3, 3, 3, 3, 3, 2, 2, 3, 1, 2, 2, 3, 3, 2, 2, 2, 1, 1, 1, 1};
constexpr bool kTimed[kArguments] = {true, true, true, true, true, true, true,  true,  false, false, true,
                                     true, true, true, true, true, true, false, false, false, false};
constexpr size_t kPolicy = 8, kKey = 19, kNoiseKey = 20;

template <typename T, bool kTogether>
struct Given {
  static constexpr size_t kLanes = Kind<T, kTogether>::kLanes;
  using Part = Series<T, kTogether>;

  Part A, B, K, Q, R, N, state_target, input_target, M, x0, w, scale, location, matrices, ahead, back, rest;
  Part noise_scale, noise_centre;
  std::array<Stream, kLanes> streams, noise_streams;

  Given(const std::vector<Argument>& all, const Places<kLanes>& paths)
      : A(all[0], paths), B(all[1], paths), K(all[2], paths), Q(all[3], paths), R(all[4], paths), N(all[5], paths),
        state_target(all[6], paths), input_target(all[7], paths), M(all[kPolicy], paths), x0(all[9], paths),
        w(all[10], paths), scale(all[11], paths), location(all[12], paths), matrices(all[13], paths),
        ahead(all[14], paths), back(all[15], paths), rest(all[16], paths), noise_scale(all[17], paths),
        noise_centre(all[18], paths), streams(Streams(all[kKey], paths)), noise_streams(Streams(all[kNoiseKey], paths)) {}

 private:
  static std::array<Stream, kLanes> Streams(const Argument& keys, const Places<kLanes>& paths) {
    std::array<Stream, kLanes> streams;
    for (size_t lane = 0; lane < kLanes; ++lane) {
      const auto* key = reinterpret_cast<const uint32_t*>(keys.Of(paths[lane]));
      streams[lane] = {uint64_t{key[0]} << 32 | key[1], uint64_t{key[2]} << 32 | key[3]};
    }
    return streams;
  }
};

}  // namespace perfcontrol

#endif  // PERFCONTROL_ARGUMENTS_H_
