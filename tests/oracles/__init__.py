"""Slow, dense test oracles in plain NumPy, each derived from the model definition and not from the package.

The model, for t = 0..T-1, with z_t = x_t, or z_t = [x_t; u_t] where the perturbations have n + m columns:

    x_{t+1} = A_t x_t + B_t u_t + Delta_t z_t + w_t
    u_t = -K_t x_t + sum_{i=1..H} M[i-1] w_{t-i},    w_j = 0 for j < 0

and the cost, terminal stage included, of x~_t = x_t - xs_t and u~_t = u_t - us_t:

    sum_{t=0..T} x~_t' Q_t x~_t + u~_t' R_t u~_t + 2 x~_t' N_t u~_t

Delta_t, w_t and x_0 are independent of each other and over time. No module here imports another.
"""
