/* Least squares in joint space: Cholesky factor, Levenberg-Marquardt. */
#pragma once
#include "chain.h"

/* Cholesky factor of a symmetric matrix, of which the lower part is given, in place; 0 if not positive definite. */
static int factorise(double A[N][N])
{
    int i, j, k;
    for (j = 0; j < N; ++j) {
        for (i = j; i < N; ++i) {
            double s = A[i][j];
            for (k = 0; k < j; ++k) {
                s -= A[i][k] * A[j][k];
            }
            if (i == j) {
                if (!(s > 0.0)) {
                    return 0;
                }
                A[j][j] = sqrt(s);
            } else {
                A[i][j] = s / A[j][j];
            }
        }
    }
    return 1;
}

/* Solve L L' x = b in place. */
static void substitute(double L[N][N], double *b)
{
    int i, k;
    for (i = 0; i < N; ++i) {
        for (k = 0; k < i; ++k) {
            b[i] -= L[i][k] * b[k];
        }
        b[i] /= L[i][i];
    }
    for (i = N - 1; i >= 0; --i) {
        for (k = i + 1; k < N; ++k) {
            b[i] -= L[k][i] * b[k];
        }
        b[i] /= L[i][i];
    }
}

static double weighted(const double *r)
{
    return dot(r, r) + ROTATION_LENGTH * ROTATION_LENGTH * dot(r + 3, r + 3);
}

/* Levenberg-Marquardt from q; returns 1 if the frame is reached. */
static int refine(const double *target, double *q, int iterations)
{
    double T[12], J[6 * N], r[6], cost, damping = 1e-3;
    int round, i, j, k;
    chain(q, T, J);
    difference(T, target, r);
    cost = weighted(r);
    for (round = 0; round < iterations && cost > 1e-22 && damping < 1e8; ++round) {
        double A[N][N], b[N], trial[N], T2[12], J2[6 * N], r2[6], cost2, largest = 1.0;
        double shift = damping * fmax(sqrt(cost), 1e-12) + 1e-14;
        for (i = 0; i < N; ++i) {
            for (j = 0; j <= i; ++j) {
                double s = 0.0;
                for (k = 0; k < 6; ++k) {
                    s += (k < 3 ? 1.0 : ROTATION_LENGTH * ROTATION_LENGTH) * J[6 * i + k] * J[6 * j + k];
                }
                A[i][j] = s + (i == j ? shift : 0.0);
            }
            b[i] = 0.0;
            for (k = 0; k < 6; ++k) {
                b[i] += (k < 3 ? 1.0 : ROTATION_LENGTH * ROTATION_LENGTH) * J[6 * i + k] * r[k];
            }
        }
        if (!factorise(A)) {
            damping *= 8.0;
            continue;
        }
        substitute(A, b);
        for (i = 0; i < N; ++i) {
            largest = fmax(largest, fabs(b[i]));
        }
        for (i = 0; i < N; ++i) {
            trial[i] = q[i] + b[i] / largest;
        }
        chain(trial, T2, J2);
        difference(T2, target, r2);
        cost2 = weighted(r2);
        if (cost2 < cost) {
            memcpy(q, trial, sizeof trial);
            memcpy(J, J2, sizeof J);
            memcpy(r, r2, sizeof r);
            cost = cost2;
            damping = fmax(0.2 * damping, 1e-9);
        } else {
            damping *= 8.0;
        }
    }
#if N >= 6
    return cost < 1e-18;
#else
    return dot(r, r) < 1e-14 && dot(r + 3, r + 3) < TILT_TOLERANCE * TILT_TOLERANCE;
#endif
}
