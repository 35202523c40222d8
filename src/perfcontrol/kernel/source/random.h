// The numbers of `pc.fast_key`, in C++: see random_keys.py for what they are and why streams do not meet.

#ifndef PERFCONTROL_RANDOM_H_
#define PERFCONTROL_RANDOM_H_

#include <algorithm>
#include <array>
#include <cmath>
#include <cstddef>
#include <cstdint>

namespace perfcontrol {

struct Stream {
  uint64_t a, b;

  static uint64_t Mix(uint64_t z) {
    z = (z ^ (z >> 30)) * 0xBF58476D1CE4E5B9u;
    z = (z ^ (z >> 27)) * 0x94D049BB133111EBu;
    return z ^ (z >> 31);
  }
  Stream FoldIn(uint64_t number) const {
    constexpr uint64_t odd = 0x9E3779B97F4A7C15u;
    return {Mix(a + odd * (2 * number + 1)), Mix(b + odd)};
  }
  uint64_t Multiplier() const { return a | 1; }
  uint64_t First() const { return b + (a << 63); }
};

inline uint64_t Swapped(uint64_t x) { return (x >> 32) | (x << 32); }

// The fourth round of squaring, `first` being counter times k.
inline uint64_t Fourth(uint64_t first, uint64_t k) {
  const uint64_t z = first + k;
  uint64_t x = Swapped(first * first + first);
  x = Swapped(x * x + z);
  x = Swapped(x * x + first);
  return x * x + z;
}

inline uint32_t Word32(uint64_t counter, uint64_t k) { return static_cast<uint32_t>(Fourth(counter * k, k) >> 32); }

inline uint64_t Word64(uint64_t counter, uint64_t k) {
  const uint64_t first = counter * k, x = Fourth(first, k), s = Swapped(x);
  return x ^ ((s * s + first) >> 32);
}

constexpr double kRoot3 = 1.7320508075688772;

// Uniform on [-√3, √3): as many of the high bits of a word as a number in [1, 2) has digits.
inline float Uniform(float, uint64_t counter, uint64_t k) {
  const float digits = static_cast<float>(static_cast<int32_t>(Word32(counter, k) >> 9)) * 0x1p-23f;
  return digits * static_cast<float>(2 * kRoot3) - static_cast<float>(kRoot3);
}

inline double Uniform(double, uint64_t counter, uint64_t k) {
  const double digits = static_cast<double>(static_cast<int64_t>(Word64(counter, k) >> 12)) * 0x1p-52;
  return digits * (2 * kRoot3) - kRoot3;
}

// log y for 0 < y <= 1, to a rounding or two: exponent, and a polynomial on [√½, √2] (S. Moshier's Cephes).
inline float Logarithm(float y) {
  const uint32_t bits = __builtin_bit_cast(uint32_t, y);
  const float mantissa = __builtin_bit_cast(float, (bits & 0x7FFFFFu) | 0x3F800000u);
  const bool high = mantissa > 1.41421356f;
  const float exponent = static_cast<float>(static_cast<int32_t>(bits >> 23) - (high ? 126 : 127));
  const float t = (high ? 0.5f * mantissa : mantissa) - 1, z = t * t;
  float p = 7.0376836292e-2f;
  p = p * t - 1.1514610310e-1f;
  p = p * t + 1.1676998740e-1f;
  p = p * t - 1.2420140846e-1f;
  p = p * t + 1.4249322787e-1f;
  p = p * t - 1.6668057665e-1f;
  p = p * t + 2.0000714765e-1f;
  p = p * t - 2.4999993993e-1f;
  p = p * t + 3.3333331174e-1f;
  return exponent * 0.693359375f + (t + (t * z * p - 0.5f * z - 2.12194440e-4f * exponent));
}

// Standard normal, as `jax.random.normal` makes it of a uniform number on (-1, 1): by the inverse of the error function
// (M. Giles, "Approximating the erfinv function", 2010).
inline float NormalOf(uint32_t word) {
  const float digits = static_cast<float>(static_cast<int32_t>(word >> 9)) * 0x1p-23f;
  const float lowest = -0x1.fffffep-1f, x = digits > 0 ? digits * 2 + lowest : lowest;
  const float w = -Logarithm((1 - x) * (1 + x)), a = w - 2.5f, b = std::sqrt(w) - 3;
  float p = 2.81022636e-08f, q = -0.000200214257f;
  p = p * a + 3.43273939e-07f, q = q * b + 0.000100950558f;
  p = p * a - 3.5233877e-06f, q = q * b + 0.00134934322f;
  p = p * a - 4.39150654e-06f, q = q * b - 0.00367342844f;
  p = p * a + 0.00021858087f, q = q * b + 0.00573950773f;
  p = p * a - 0.00125372503f, q = q * b - 0.0076224613f;
  p = p * a - 0.00417768164f, q = q * b + 0.00943887047f;
  p = p * a + 0.246640727f, q = q * b + 1.00167406f;
  p = p * a + 1.50140941f, q = q * b + 2.83297682f;
  return 1.41421356f * (x * (w < 5 ? p : q));
}

inline float Normal(float, uint64_t counter, uint64_t k) { return NormalOf(Word32(counter, k)); }

inline double Normal(double, uint64_t, uint64_t) { return 0; }  // drawn by JAX

// What `Draw` makes of numbers `first`, `first` + 1, ... of each stream, side by side.
template <typename T, size_t kLanes, T (*Draw)(T, uint64_t, uint64_t)>
void FillEach(const std::array<Stream, kLanes>& streams, uint64_t first, size_t count, T* out) {
  uint64_t k[kLanes], start[kLanes];
  for (size_t lane = 0; lane < kLanes; ++lane) {
    k[lane] = streams[lane].Multiplier();
    start[lane] = streams[lane].First() + first;
  }
  if constexpr (kLanes == 1) {
#pragma omp simd
    for (size_t i = 0; i < count; ++i) out[i] = Draw(T{}, start[0] + i, k[0]);
  } else {
    for (size_t i = 0; i < count; ++i) {
#pragma omp simd
      for (size_t lane = 0; lane < kLanes; ++lane) out[i * kLanes + lane] = Draw(T{}, start[lane] + i, k[lane]);
    }
  }
}

// Signs, thirty-two from each word.
template <typename T, size_t kLanes>
void FillSigns(const std::array<Stream, kLanes>& streams, uint64_t first, size_t count, T* out) {
  for (size_t i = 0; i < count;) {
    const uint64_t place = first + i;
    const uint32_t low = static_cast<uint32_t>(place & 31);
    const size_t some = std::min<size_t>(32 - low, count - i);
    uint32_t words[kLanes];
    for (size_t lane = 0; lane < kLanes; ++lane) {
      words[lane] = Word32(streams[lane].First() + (place >> 5), streams[lane].Multiplier()) >> low;
    }
    for (size_t bit = 0; bit < some; ++bit) {
#pragma omp simd
      for (size_t lane = 0; lane < kLanes; ++lane) {
        out[(i + bit) * kLanes + lane] = static_cast<T>(static_cast<int32_t>((words[lane] >> bit) & 1) * 2 - 1);
      }
    }
    i += some;
  }
}

enum class Law { kSigns, kUniform, kNormal };

template <typename T, size_t kLanes>
void Fill(Law law, const std::array<Stream, kLanes>& streams, uint64_t first, size_t count, T* out) {
  if (law == Law::kSigns) {
    FillSigns<T, kLanes>(streams, first, count, out);
  } else if (law == Law::kUniform) {
    FillEach<T, kLanes, Uniform>(streams, first, count, out);
  } else {
    FillEach<T, kLanes, Normal>(streams, first, count, out);
  }
}

}  // namespace perfcontrol

#endif  // PERFCONTROL_RANDOM_H_
