// One path, or several together: states and cost on a pass ahead, the cost's gradient by the policy on a pass back.

#ifndef PERFCONTROL_PATH_H_
#define PERFCONTROL_PATH_H_

#include <vector>

#include "arguments.h"
#include "numbers.h"
#include "products.h"
#include "random.h"

namespace perfcontrol {

constexpr size_t kHeld = size_t{1} << 21;  // bytes of drawn matrices kept for the way back; beyond, drawn again

// Room for drawn matrices, kept from call to call: new memory costs more than what is written into it.
template <typename Number>
std::vector<Number>& Room() {
  static thread_local std::vector<Number> room;
  return room;
}

template <typename T, bool kTogether>
class Path {
 public:
  using Number = typename Kind<T, kTogether>::Number;
  static constexpr size_t kLanes = Kind<T, kTogether>::kLanes;

  Path(Sizes sizes, Source reaction, Source noise, bool redrawn, bool gradient)
      : n_(sizes.n), m_(sizes.m), pn_(Kind<T, kTogether>::Padded(n_)), pm_(Kind<T, kTogether>::Padded(m_)),
        memory_(sizes.memory), horizon_(sizes.horizon), reaction_(reaction), noise_(noise),
        redrawn_(redrawn),
        A_(n_, n_, false), B_(n_, m_, false), K_(m_, n_, false), Q_(n_, n_, false), R_(m_, m_, false),
        N_(n_, m_, false), AT_(n_, n_, true), BT_(n_, m_, true), KT_(m_, n_, true), NT_(n_, m_, true),
        location_(n_, n_, false), locationT_(n_, n_, true), M_(memory_, Matrix<T, kTogether>(m_, n_, false)),
        x_((horizon_ + 1) * pn_), by_x_((gradient ? horizon_ + 1 : 1) * pn_), w_(x_.size()),
        by_u_((gradient ? horizon_ + 1 : 1) * pm_), kept_(gradient), u_(pm_), du_(pm_),
        dx_(pn_), y_(pn_), now_(pn_), unit_(pn_), ahead_(pn_), to_policy_(memory_ * m_ * pn_) {
    const bool drawn = reaction == kSigns || reaction == kUniform || reaction == kNormal;
    entries_ = reaction == kNormal ? 2 * n_ : n_ * pn_;
    held_ = drawn && gradient && horizon_ * entries_ * sizeof(Number) <= kHeld;
    flat_.resize(std::max(drawn ? n_ * n_ : 0, noise != kNone && pn_ > n_ ? horizon_ * n_ : 0));
    const size_t room = drawn || reaction == kMatrices ? (held_ ? horizon_ : 1) * entries_ : 0;
    if (Z_.size() < room) Z_.resize(room);
  }

  // x_{t+1} = A_t x_t + B_t u_t + w_t + Δ_t x_t,  u_t = Σ_i M[i-1] w_{t-i} - K_t x_t.
  Number Ahead(const Given<T, kTogether>& g) {
    Number cost{};
    for (size_t i = 0; i < n_; ++i) x_[i] = g.x0.At(0, i);
    MakeNoise(g);
    for (size_t t = 0; t <= horizon_; ++t) {
      const Number* x = &x_[t * pn_];
      Number *by_x = &by_x_[kept_ * t * pn_], *by_u = &by_u_[kept_ * t * pm_], *u = u_.data();
      std::fill(u_.begin(), u_.end(), Number{});
      for (size_t lag = 1; lag <= std::min(t, memory_); ++lag) {
        M_[lag - 1].AddTo(g.M, 0, &w_[(t - lag) * pn_], u, 1, (lag - 1) * m_ * n_);
      }
      if (g.K.present) K_.AddTo(g.K, t, x, u, -1);
      for (size_t i = 0; i < n_; ++i) dx_[i] = g.state_target.present ? x[i] - g.state_target.At(t, i) : x[i];
      for (size_t i = 0; i < m_; ++i) du_[i] = g.input_target.present ? u[i] - g.input_target.At(t, i) : u[i];
      std::fill_n(by_x, pn_, Number{});
      std::fill_n(by_u, pm_, Number{});
      Q_.AddTo(g.Q, t, dx_.data(), by_x);
      R_.AddTo(g.R, t, du_.data(), by_u);
      if (g.N.present) {
        N_.AddTo(g.N, t, du_.data(), by_x);
        NT_.AddTo(g.N, t, dx_.data(), by_u);
      }
      cost += Dot<T, kTogether>(dx_.data(), by_x, pn_) + Dot<T, kTogether>(du_.data(), by_u, pm_);
      if (t == horizon_) break;
      Number* following = &x_[(t + 1) * pn_];
      std::copy_n(&w_[t * pn_], pn_, following);
      A_.AddTo(g.A, t, x, following);
      B_.AddTo(g.B, t, u, following);
      React(g, t, x, following);
    }
    return cost;
  }

  // h_t = ∂c_t/∂u_t + B_tᵀ y_{t+1},  y_t = ∂c_t/∂x_t - K_tᵀ h_t + (A_t + Δ_t)ᵀ y_{t+1},  ∇_{M[i-1]} = Σ_t h_t w_{t-i}ᵀ:
  // what the gradient at M[i-1][a][b] is stands at ((i-1) m + a) · `row` + b.
  const Number* Back(const Given<T, kTogether>& g, size_t& row) {
    row = pn_;
    std::fill(to_policy_.begin(), to_policy_.end(), Number{});
    for (size_t t = horizon_ + 1; t-- > 0;) {
      Number *h = u_.data(), *y = y_.data(), *now = now_.data();
      for (size_t i = 0; i < pm_; ++i) h[i] = 2 * by_u_[t * pm_ + i];
      for (size_t i = 0; i < pn_; ++i) now[i] = 2 * by_x_[t * pn_ + i];
      if (t < horizon_) {
        BT_.AddTo(g.B, t, y, h);
        AT_.AddTo(g.A, t, y, now);
        ReactBack(g, t, &x_[t * pn_], y, now);
      }
      if (g.K.present) KT_.AddTo(g.K, t, h, now, -1);
      std::swap(y_, now_);
      for (size_t lag = 1; lag <= std::min(t, memory_); ++lag) {
        const Number* w = &w_[(t - lag) * pn_];
        for (size_t i = 0; i < m_; ++i) {
          Number* to = &to_policy_[((lag - 1) * m_ + i) * pn_];
          for (size_t j = 0; j < pn_; ++j) to[j] += h[i] * w[j];
        }
      }
    }
    return to_policy_.data();
  }

 private:
  static Law LawOf(Source source) {
    return source == kSigns ? Law::kSigns : source == kUniform ? Law::kUniform : Law::kNormal;
  }

  // w_t: as given, or drawn about its centre.
  void MakeNoise(const Given<T, kTogether>& g) {
    T* raw = pn_ == n_ ? reinterpret_cast<T*>(w_.data()) : flat_.data();  // in its place, unless zeros stand between
    if (noise_ != kNone) Fill<T, kLanes>(LawOf(noise_), g.noise_streams, 0, horizon_ * n_, raw);
    for (size_t t = 0; t < horizon_; ++t) {
      for (size_t i = 0; i < n_; ++i) {
        Number w;
        if (noise_ == kNone) {
          w = g.w.At(t, i);
        } else {
          std::memcpy(&w, raw + (t * n_ + i) * kLanes, sizeof(w));
          w = g.noise_centre.At(0, i) + g.noise_scale.At(0, i) * w;
        }
        w_[t * pn_ + i] = w;
      }
    }
  }

  // Z_t, by rows; of normal entries the numbers that its two products are made of.
  const Number* Drawn(const Given<T, kTogether>& g, size_t t, bool again) {
    Number* Z = Z_.data() + (held_ ? t * entries_ : 0);
    if (held_ && again) return Z;
    if (reaction_ == kMatrices) {
      for (size_t i = 0; i < n_; ++i) {
        for (size_t j = 0; j < pn_; ++j) Z[i * pn_ + j] = j < n_ ? g.matrices.At(t, i * n_ + j) : Number{};
      }
      return Z;
    }
    auto streams = g.streams;
    if (redrawn_) {
      for (Stream& stream : streams) stream = stream.FoldIn(t);
    }
    const bool whole = kTogether || reaction_ == kNormal;  // as they come, or row by row with zeros behind
    const size_t count = reaction_ == kNormal ? 2 * n_ : n_ * n_;
    T* to = whole ? reinterpret_cast<T*>(Z) : flat_.data();
    Fill<T, kLanes>(LawOf(reaction_), streams, redrawn_ ? 0 : t * count, count, to);
    if constexpr (!kTogether) {
      for (size_t i = 0; i < n_ && !whole; ++i) {
        std::copy_n(flat_.data() + i * n_, n_, Z + i * pn_);
        std::fill_n(Z + i * pn_ + n_, pn_ - n_, T{0});
      }
    }
    return Z;
  }

  void AddDrawn(const Number* Z, bool transposed, const Number* x, Number* to, Number factor) {
    if constexpr (kTogether) {
      AddTogether<T>(Z, transposed ? 1 : n_, transposed ? n_ : 1, x, n_, to, n_, factor);
    } else if (transposed) {
      AddRows(Z, x, n_, to, pn_, factor);
    } else {
      AddByRows(Z, x, pn_, to, n_, factor);
    }
  }

  bool ByProducts() const { return reaction_ == kProducts || reaction_ == kNormal; }

  // Leaves in ahead_ what `WhiteDraws` calls so, and returns its ρ, with normal entries brought to the sphere here.
  Number MakeAhead(const Given<T, kTogether>& g, size_t t, bool again) {
    Number factor = Number{} + 1, squared{};
    if (reaction_ == kProducts) {
      for (size_t i = 0; i < n_; ++i) ahead_[i] = g.ahead.At(t, i);
      return g.rest.present ? g.rest.At(t, 0) : factor;
    }
    const Number* normal = Drawn(g, t, again);
    if (!g.rest.present) {
      std::copy_n(normal, n_, ahead_.begin());
      return factor;
    }
    for (size_t i = 0; i < n_; ++i) squared += normal[i] * normal[i];
    factor = Root(static_cast<T>(n_ * n_) * Inverse(squared + g.rest.At(t, 0)));
    for (size_t i = 0; i < n_; ++i) ahead_[i] = factor * normal[i];
    return factor * Root(g.rest.At(t, 0));
  }

  // to += Δ_t x.
  void React(const Given<T, kTogether>& g, size_t t, const Number* x, Number* to) {
    if (ByProducts()) {
      MakeAhead(g, t, false);
      const Number size = g.scale.At(t, 0) * Root(Dot<T, kTogether>(x, x, pn_));
      for (size_t i = 0; i < n_; ++i) to[i] += size * ahead_[i];
    } else if (reaction_ != kNone) {
      AddDrawn(Drawn(g, t, false), false, x, to, g.scale.At(t, 0));
    }
    if (g.location.present) location_.AddTo(g.location, t, x, to);
  }

  // to += Δ_tᵀ y, after Δ_t was applied to x.
  void ReactBack(const Given<T, kTogether>& g, size_t t, const Number* x, const Number* y, Number* to) {
    if (ByProducts()) {
      ProductsBack(g, t, x, y, to);
    } else if (reaction_ != kNone) {
      AddDrawn(Drawn(g, t, true), true, y, to, g.scale.At(t, 0));
    }
    if (g.location.present) locationT_.AddTo(g.location, t, y, to);
  }

  // As `WhiteDraws` has it: the part along x is known from the way ahead, the part across is free.
  void ProductsBack(const Given<T, kTogether>& g, size_t t, const Number* x, const Number* y, Number* to) {
    const Number size = Root(Dot<T, kTogether>(x, x, pn_)), inverse = Inverse(size);
    const Number radius = MakeAhead(g, t, true);
    Number* back = dx_.data();
    const Number* normal = Z_.data() + (held_ ? t * entries_ : 0);  // drawn by MakeAhead
    for (size_t i = 0; i < n_; ++i) back[i] = reaction_ == kProducts ? g.back.At(t, i) : normal[n_ + i];
    for (size_t i = 0; i < n_; ++i) unit_[i] = inverse * x[i];
    unit_[0] += 1 - IsPositive(size);  // any direction will do where x vanishes
    const Number along = Dot<T, kTogether>(unit_.data(), back, pn_);
    for (size_t i = 0; i < n_; ++i) back[i] -= along * unit_[i];
    Number across = g.scale.At(t, 0) * Root(Dot<T, kTogether>(y, y, pn_)), reached{};
    if (g.rest.present) {
      across *= radius * Inverse(Root(Dot<T, kTogether>(back, back, pn_) + g.rest.At(t, 1)));
    }
    for (size_t i = 0; i < n_; ++i) reached += ahead_[i] * y[i];
    reached *= g.scale.At(t, 0);
    for (size_t i = 0; i < n_; ++i) to[i] += reached * unit_[i] + across * back[i];
  }

  size_t n_, m_, pn_, pm_, memory_, horizon_, entries_ = 0;
  Source reaction_, noise_;
  bool redrawn_, held_ = false;
  Matrix<T, kTogether> A_, B_, K_, Q_, R_, N_, AT_, BT_, KT_, NT_, location_, locationT_;
  std::vector<Matrix<T, kTogether>> M_;
  std::vector<Number> x_, by_x_, w_, by_u_;
  size_t kept_;  // 1 where the gradients of all stages are, for the way back; else 0
  std::vector<Number> u_, du_, dx_, y_, now_, unit_, ahead_, to_policy_;
  std::vector<Number>& Z_ = Room<Number>();
  std::vector<T> flat_;
};

}  // namespace perfcontrol

#endif  // PERFCONTROL_PATH_H_
