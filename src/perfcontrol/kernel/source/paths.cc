// The cost of paths under dense perturbations, and its gradient by the policy: a call of XLA's for many paths.
//
// The same numbers, to rounding, as `sample_along` and `path_gradient` give for the same key.

#include <new>
#include <vector>

#include "arguments.h"
#include "path.h"
#include "xla/ffi/api/ffi.h"

namespace perfcontrol {
namespace {

namespace ffi = xla::ffi;
using Answer = ffi::Result<ffi::AnyBuffer>;

struct Work {
  const std::vector<Argument>& arguments;
  const std::vector<size_t>& axes;
  Sizes sizes;
  Source reaction, noise;
  bool redrawn, gradient;

  std::vector<size_t> Place(size_t index) const {
    std::vector<size_t> place(axes.size());
    for (size_t axis = axes.size(); axis-- > 0; index /= axes[axis]) place[axis] = index % axes[axis];
    return place;
  }
};

// Paths `first`, ..., `last` - 1, as many together as a register holds; the last of them again where some are missing.
template <typename T, bool kTogether>
void Run(const Work& work, size_t first, size_t last, T* costs, T* gradients) {
  if (first == last) return;
  constexpr size_t kLanes = Kind<T, kTogether>::kLanes;
  const auto [n, m, memory, horizon] = work.sizes;
  Path<T, kTogether> path(work.sizes, work.reaction, work.noise, work.redrawn, work.gradient);
  for (; first < last; first += kLanes) {
    Places<kLanes> places;
    for (size_t lane = 0; lane < kLanes; ++lane) places[lane] = work.Place(std::min(first + lane, last - 1));
    const Given<T, kTogether> given(work.arguments, places);
    const auto cost = path.Ahead(given);
    const auto* entries = reinterpret_cast<const T*>(&cost);
    const size_t lanes = std::min(kLanes, last - first);
    std::copy_n(entries, lanes, costs + first);
    if (!work.gradient) continue;
    size_t stride = 0;
    entries = reinterpret_cast<const T*>(path.Back(given, stride));
    for (size_t lane = 0; lane < lanes; ++lane) {
      T* out = gradients + (first + lane) * memory * m * n;
      for (size_t row = 0; row < memory * m; ++row) {
        for (size_t j = 0; j < n; ++j) out[row * n + j] = entries[(row * stride + j) * kLanes + lane];
      }
    }
  }
}

template <typename T>
void RunAll(const Work& work, Answer cost, Answer gradients) {
  T *costs = static_cast<T*>(cost->untyped_data()), *out = static_cast<T*>(gradients->untyped_data());
  constexpr size_t kLanes = Kind<T, true>::kLanes;
  const size_t count = cost->element_count(), left = count % kLanes;
  const size_t alone = left <= kLanes / 4 ? left : 0;  // so few are faster one by one
  Run<T, true>(work, 0, count - alone, costs, out);
  Run<T, false>(work, count - alone, count, costs, out);
}

ffi::Error Paths(ffi::RemainingArgs buffers, Answer cost, Answer gradients, int64_t reaction, int64_t noise,
                 int64_t horizon, bool redrawn, bool gradient) {
  const ffi::DataType type = cost->element_type();
  if (type != ffi::DataType::F32 && type != ffi::DataType::F64) {
    return ffi::Error::InvalidArgument("neither float32 nor float64");
  }
  if (buffers.size() != kArguments) return ffi::Error::InvalidArgument("wrong number of arguments");
  const std::vector<size_t> axes(cost->dimensions().begin(), cost->dimensions().end());
  std::vector<Argument> arguments;
  Sizes sizes{};
  sizes.horizon = horizon;
  for (size_t i = 0; i < kArguments; ++i) {
    const auto buffer = buffers.get<ffi::AnyBuffer>(i);
    const bool key = i == kKey || i == kNoiseKey;
    if (buffer.has_error() || buffer->dimensions().size() != axes.size() + kInner[i] ||
        buffer->element_type() != (key ? ffi::DataType::U32 : type)) {
      return ffi::Error::InvalidArgument("argument " + std::to_string(i) + " does not fit");
    }
    const auto dims = buffer->dimensions();
    if (i == kPolicy) sizes.memory = dims[axes.size()], sizes.m = dims[axes.size() + 1], sizes.n = dims[axes.size() + 2];
    arguments.emplace_back(*buffer, kInner[i], key ? 4 : ffi::ByteWidth(type), kTimed[i]);
  }
  const auto drawn = static_cast<Source>(reaction), noisy = static_cast<Source>(noise);
  const Work work{arguments, axes, sizes, drawn, noisy, redrawn, gradient};
  try {
    if (type == ffi::DataType::F32) {
      RunAll<float>(work, cost, gradients);
    } else {
      RunAll<double>(work, cost, gradients);
    }
  } catch (const std::bad_alloc&) {
    return ffi::Error(ffi::ErrorCode::kResourceExhausted, "there is not memory enough for these paths");
  }
  return ffi::Error::Success();
}

}  // namespace
}  // namespace perfcontrol

XLA_FFI_DEFINE_HANDLER_SYMBOL(PerfcontrolPaths, perfcontrol::Paths,
                              xla::ffi::Ffi::Bind()
                                  .RemainingArgs()
                                  .Ret<xla::ffi::AnyBuffer>()
                                  .Ret<xla::ffi::AnyBuffer>()
                                  .Attr<int64_t>("reaction")
                                  .Attr<int64_t>("noise")
                                  .Attr<int64_t>("horizon")
                                  .Attr<bool>("redrawn")
                                  .Attr<bool>("gradient"));
