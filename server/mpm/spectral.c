// Logarithm and exponential of symmetric tensors by eigenvalues: closed in 2D, by Jacobi in 3D.
#include "server/mpm/spectral.h"

// Eigenvalues w and eigenvectors (columns of the row-major Q) by cyclic Jacobi rotations.
static void eigen_sym3(const double *s, double *w, double *Q) {
    double A[9] = {s[0], s[3], s[5], s[3], s[1], s[4], s[5], s[4], s[2]};
    for (int k = 0; k < 9; k++) {
        Q[k] = k % 4 == 0;
    }
    for (int sweep = 0; sweep < 50; sweep++) { // converges quadratically: 6 or 7 in practice
        int rotated = 0;
        for (int p = 0; p < 2; p++) {
            for (int q = p + 1; q < 3; q++) {
                const double a = A[3 * p + q];
                // Off-diagonals below round-off of both diagonals: keeps small eigenvalues
                // relative.
                if (fabs(a) <= 1e-17 * sqrt(fabs(A[4 * p] * A[4 * q]))) {
                    continue;
                }
                rotated = 1;
                const double theta = (A[4 * q] - A[4 * p]) / (2 * a);
                const double t = copysign(1, theta) / (fabs(theta) + sqrt(theta * theta + 1));
                const double c = 1 / sqrt(t * t + 1), n = t * c;
                A[4 * p] -= t * a;
                A[4 * q] += t * a;
                A[3 * p + q] = A[3 * q + p] = 0;
                const int r = 3 - p - q;
                const double arp = A[3 * r + p], arq = A[3 * r + q];
                A[3 * r + p] = A[3 * p + r] = c * arp - n * arq;
                A[3 * r + q] = A[3 * q + r] = n * arp + c * arq;
                for (int k = 0; k < 3; k++) {
                    const double kp = Q[3 * k + p], kq = Q[3 * k + q];
                    Q[3 * k + p] = c * kp - n * kq;
                    Q[3 * k + q] = n * kp + c * kq;
                }
            }
        }
        if (!rotated) {
            break;
        }
    }
    for (int k = 0; k < 3; k++) {
        w[k] = A[4 * k];
    }
}

void mpm_from_eigen(const double *w, const double *Q, double *s) {
    for (int k = 0; k < 6; k++) {
        const int i = mpm_sym_row(k), j = mpm_sym_column(k);
        s[k] = 0;
        for (int d = 0; d < 3; d++) {
            s[k] += w[d] * Q[3 * i + d] * Q[3 * j + d];
        }
    }
}

// atanh(r/m)/r for 0 <= r < m, with its limit 1/m; log_det = ln(m^2 - r^2) is better known than m -
// r where the eigenvalues lie far apart.
static double atanh_ratio(const double r, const double m, const double log_det) {
    const double q = r / m;
    return q < 1e-4 ? (1 + q * q / 3) / m : q < 0.5 ? atanh(q) / r : (log(m + r) - log_det / 2) / r;
}

static void half_log_2d(const double *b, double *e) {
    // ln b = ln(det)/2 1 + atanh(r/m)/r (b - m 1), with eigenvalues m +- r
    const double m = 0.5 * (b[0] + b[1]), half = 0.5 * (b[0] - b[1]);
    const double r = sqrt(half * half + b[3] * b[3]);
    const double det = b[0] * b[1] - b[3] * b[3];
    const double log_det = log(det), mean = 0.25 * log_det;
    const double f = 0.5 * atanh_ratio(r, m, log_det);
    e[0] = mean + f * half;
    e[1] = mean - f * half;
    e[2] = 0.5 * log(b[2]);
    e[3] = f * b[3];
}

static void exp_twice_2d(const double *e, double *b) {
    const double m = e[0] + e[1], half = e[0] - e[1], shear = 2 * e[3]; // of 2 e
    const double r = sqrt(half * half + shear * shear), scale = exp(m);
    const double s = r < 1e-4 ? 1 + r * r / 6 : sinh(r) / r, c = cosh(r);
    b[2] = exp(2 * e[2]);
    b[3] = scale * s * shear;
    // The smaller diagonal entry from the determinant, scale^2: c - s |half| would cancel.
    const int large = half < 0;
    b[large] = scale * (c + s * fabs(half));
    b[!large] = (scale * scale + b[3] * b[3]) / b[large];
}

static double half_log(double x) {
    return 0.5 * log(x);
}
static double exp_twice(double x) {
    return exp(2 * x);
}

static void by_lane(void (*in_2d)(const double *, double *), double (*f)(double), const double *x,
                    double *y, int dim, int n_lanes, unsigned lanes) {
    for (int i = 0; i < n_lanes; i++) {
        if (!(lanes >> i & 1)) {
            continue;
        }
        double in[6] = {0}, out[6];
        for (int k = 0; k < MPM_SYM(dim); k++) {
            in[k] = x[k * n_lanes + i];
        }
        if (dim == 2) {
            in_2d(in, out);
        } else {
            double w[3], Q[9];
            eigen_sym3(in, w, Q);
            for (int d = 0; d < 3; d++) {
                w[d] = f(w[d]);
            }
            mpm_from_eigen(w, Q, out);
        }
        for (int k = 0; k < MPM_SYM(dim); k++) {
            y[k * n_lanes + i] = out[k];
        }
    }
}

void mpm_half_log_far(const double *b, double *e, int dim, int n_lanes, unsigned lanes) {
    by_lane(half_log_2d, half_log, b, e, dim, n_lanes, lanes);
}

void mpm_exp_twice_far(const double *e, double *b, int dim, int n_lanes, unsigned lanes) {
    by_lane(exp_twice_2d, exp_twice, e, b, dim, n_lanes, lanes);
}
