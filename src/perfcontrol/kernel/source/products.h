// Products of small matrices with vectors.
//
// Of one path: vectors are padded with zeros to whole registers, and so are the rows of a packed matrix; row j of it is
// what entry j of the input adds to the output. Of paths together: a register holds one entry of all of them.

#ifndef PERFCONTROL_PRODUCTS_H_
#define PERFCONTROL_PRODUCTS_H_

#include <cstddef>
#include <cstring>
#include <vector>

#include "arguments.h"
#include "numbers.h"

namespace perfcontrol {

template <typename T>
inline Register<T> Load(const T* from) {
  Register<T> value;
  std::memcpy(&value, from, sizeof(value));
  return value;
}

template <typename T>
inline void Store(Register<T> value, T* to) {
  std::memcpy(to, &value, sizeof(value));
}

template <typename T>
inline T Sum(Register<T> value) {
  T sum = 0;
  for (size_t i = 0; i < kWidth<T>; ++i) sum += value[i];
  return sum;
}

// a · b, of padded vectors.
template <typename T, bool kTogether, typename Number = typename Kind<T, kTogether>::Number>
inline Number Dot(const Number* a, const Number* b, size_t size) {
  if constexpr (kTogether) {
    Number sum{};
    for (size_t i = 0; i < size; ++i) sum += a[i] * b[i];
    return sum;
  } else {
    Register<T> sum{};
    for (size_t i = 0; i < size; i += kWidth<T>) sum += Load(a + i) * Load(b + i);
    return Sum<T>(sum);
  }
}

// --- one path --------------------------------------------------------------------------------------------------------

// `kBlocks` registers of the output; two sums of each, as one waits for itself.
template <typename T, size_t kBlocks>
inline void AddBlocks(const T* packed, size_t stride, const T* x, size_t inputs, T factor, T* y) {
  Register<T> even[kBlocks]{}, odd[kBlocks]{};
  size_t j = 0;
  for (; j + 1 < inputs; j += 2) {
    for (size_t k = 0; k < kBlocks; ++k) {
      even[k] += Load(packed + j * stride + k * kWidth<T>) * x[j];
      odd[k] += Load(packed + (j + 1) * stride + k * kWidth<T>) * x[j + 1];
    }
  }
  for (size_t k = 0; k < kBlocks && j < inputs; ++k) even[k] += Load(packed + j * stride + k * kWidth<T>) * x[j];
  for (size_t k = 0; k < kBlocks; ++k) {
    T* to = y + k * kWidth<T>;
    Store<T>(Load(to) + (even[k] + odd[k]) * factor, to);
  }
}

// y += factor · Σ_j x_j · (row j of the packed matrix).
template <typename T>
inline void AddRows(const T* packed, const T* x, size_t inputs, T* y, size_t padded, T factor) {
  size_t at = 0;
  for (; padded - at >= 3 * kWidth<T>; at += 3 * kWidth<T>) {
    AddBlocks<T, 3>(packed + at, padded, x, inputs, factor, y + at);
  }
  if (padded - at == 2 * kWidth<T>) AddBlocks<T, 2>(packed + at, padded, x, inputs, factor, y + at);
  if (padded - at == kWidth<T>) AddBlocks<T, 1>(packed + at, padded, x, inputs, factor, y + at);
}

// y_i += factor · (row i of the packed matrix) · x.
template <typename T>
inline void AddByRows(const T* packed, const T* x, size_t padded, T* y, size_t outputs, T factor) {
  size_t i = 0;
  for (; i + 3 < outputs; i += 4) {
    Register<T> sums[4]{};
    for (size_t j = 0; j < padded; j += kWidth<T>) {
      const Register<T> part = Load(x + j);
      for (size_t k = 0; k < 4; ++k) sums[k] += Load(packed + (i + k) * padded + j) * part;
    }
    for (size_t k = 0; k < 4; ++k) y[i + k] += factor * Sum<T>(sums[k]);
  }
  for (; i < outputs; ++i) y[i] += factor * Dot<T, false>(packed + i * padded, x, padded);
}

// --- paths together --------------------------------------------------------------------------------------------------

// y_i += factor · Σ_j A_ij x_j with A_ij at i `row` + j `column`, the same for all paths or of each its own.
template <typename T, typename Entry>
inline void AddTogether(const Entry* A, size_t row, size_t column, const Lanes<T>* x, size_t inputs, Lanes<T>* y,
                        size_t outputs, Lanes<T> factor) {
  size_t i = 0;
  for (; i + 3 < outputs; i += 4) {
    Lanes<T> sums[4]{};
    for (size_t j = 0; j < inputs; ++j) {
      for (size_t k = 0; k < 4; ++k) sums[k] += A[(i + k) * row + j * column] * x[j];
    }
    for (size_t k = 0; k < 4; ++k) y[i + k] += factor * sums[k];
  }
  for (; i < outputs; ++i) {
    Lanes<T> sum{};
    for (size_t j = 0; j < inputs; ++j) sum += A[i * row + j * column] * x[j];
    y[i] += factor * sum;
  }
}

// --- matrices of the problem -----------------------------------------------------------------------------------------

// A, or Aᵀ, looked at and packed anew only where it is another one. A diagonal costs as many products as it has entries.
template <typename T, bool kTogether>
class Matrix {
 public:
  using Number = typename Kind<T, kTogether>::Number;

  Matrix(size_t rows, size_t columns, bool transposed)
      : rows_(rows), columns_(columns), padded_(Kind<T, kTogether>::Padded(transposed ? columns : rows)),
        transposed_(transposed) {}

  // y += factor · A_t x, or Aᵀ_t x; `offset`: where the entries begin in the series.
  void AddTo(const Series<T, kTogether>& A, size_t t, const Number* x, Number* y, T factor = 1, size_t offset = 0) {
    const size_t inputs = transposed_ ? rows_ : columns_, outputs = transposed_ ? columns_ : rows_;
    const size_t row = transposed_ ? 1 : columns_, column = transposed_ ? columns_ : 1;
    const T* shared = A.data[0] + t * A.step + offset;
    Meet(A, t, offset, shared);
    if (diagonal_) {
      for (size_t i = 0; i < rows_; ++i) y[i] += factor * shared[i * (columns_ + 1)] * x[i];
    } else if constexpr (!kTogether) {
      AddRows(packed_.data(), x, inputs, y, padded_, factor);
    } else if (A.shared) {
      AddTogether<T>(shared, row, column, x, inputs, y, outputs, Number{} + factor);
    } else {
      AddTogether<T>(packed_.data(), row, column, x, inputs, y, outputs, Number{} + factor);
    }
  }

 private:
  void Meet(const Series<T, kTogether>& A, size_t t, size_t offset, const T* shared) {
    if (A.data == met_ && t * A.step + offset == met_at_) return;
    met_ = A.data, met_at_ = t * A.step + offset;
    diagonal_ = A.shared && rows_ == columns_;
    for (size_t i = 0; i < rows_ && diagonal_; ++i) {
      for (size_t j = 0; j < columns_; ++j) diagonal_ &= i == j || shared[i * columns_ + j] == 0;
    }
    if (diagonal_ || (kTogether && A.shared)) return;
    packed_.assign(kTogether ? rows_ * columns_ : (transposed_ ? rows_ : columns_) * padded_, Number{});
    for (size_t i = 0; i < rows_; ++i) {
      for (size_t j = 0; j < columns_; ++j) {
        const size_t to = kTogether ? i * columns_ + j : transposed_ ? i * padded_ + j : j * padded_ + i;
        packed_[to] = A.At(t, offset + i * columns_ + j);
      }
    }
  }

  size_t rows_, columns_, padded_;
  bool transposed_, diagonal_ = false;
  std::array<const T*, Kind<T, kTogether>::kLanes> met_{};
  size_t met_at_ = 0;
  std::vector<Number> packed_;
};

}  // namespace perfcontrol

#endif  // PERFCONTROL_PRODUCTS_H_
