/* Vectors and frames (the upper three rows of a homogeneous matrix, row by row). */
#pragma once
#include "robot_data.h"

#define TURN 6.28318530717958647693
#define LIMIT_TOLERANCE 1e-9
#define EDGE 1e-9

static double dot(const double *a, const double *b)
{
    return a[0] * b[0] + a[1] * b[1] + a[2] * b[2];
}

static void cross(const double *a, const double *b, double *c)
{
    c[0] = a[1] * b[2] - a[2] * b[1];
    c[1] = a[2] * b[0] - a[0] * b[2];
    c[2] = a[0] * b[1] - a[1] * b[0];
}

static void turn(const double *R, const double *a, double *b)
{
    b[0] = R[0] * a[0] + R[1] * a[1] + R[2] * a[2];
    b[1] = R[4] * a[0] + R[5] * a[1] + R[6] * a[2];
    b[2] = R[8] * a[0] + R[9] * a[1] + R[10] * a[2];
}

static void multiply(const double *A, const double *B, double *C)
{
    int i, j;
    for (i = 0; i < 3; ++i) {
        for (j = 0; j < 4; ++j) {
            C[4 * i + j] = A[4 * i] * B[j] + A[4 * i + 1] * B[4 + j] + A[4 * i + 2] * B[8 + j];
        }
        C[4 * i + 3] += A[4 * i + 3];
    }
}

static void invert(const double *A, double *B)
{
    int i, j;
    for (i = 0; i < 3; ++i) {
        for (j = 0; j < 3; ++j) {
            B[4 * i + j] = A[4 * j + i];
        }
        B[4 * i + 3] = -(A[i] * A[3] + A[4 + i] * A[7] + A[8 + i] * A[11]);
    }
}

/* Twist (rho, omega) that moves A onto B, in the coordinates of A. */
static void difference(const double *A, const double *B, double *twist)
{
    double I[12], C[12], q[4], n, sine, angle, factor;
    int i;
    invert(A, I);
    multiply(I, B, C);
    twist[0] = C[3];
    twist[1] = C[7];
    twist[2] = C[11];
    if (C[0] + C[5] + C[10] > 0.0) {
        q[0] = 1.0 + C[0] + C[5] + C[10];
        q[1] = C[9] - C[6];
        q[2] = C[2] - C[8];
        q[3] = C[4] - C[1];
    } else if (C[0] >= C[5] && C[0] >= C[10]) {
        q[0] = C[9] - C[6];
        q[1] = 1.0 + C[0] - C[5] - C[10];
        q[2] = C[4] + C[1];
        q[3] = C[2] + C[8];
    } else if (C[5] >= C[10]) {
        q[0] = C[2] - C[8];
        q[1] = C[4] + C[1];
        q[2] = 1.0 + C[5] - C[0] - C[10];
        q[3] = C[9] + C[6];
    } else {
        q[0] = C[4] - C[1];
        q[1] = C[2] + C[8];
        q[2] = C[9] + C[6];
        q[3] = 1.0 + C[10] - C[0] - C[5];
    }
    n = sqrt(q[0] * q[0] + dot(q + 1, q + 1));
    if (q[0] < 0.0) {
        n = -n;
    }
    for (i = 0; i < 4; ++i) {
        q[i] /= n;
    }
    sine = sqrt(dot(q + 1, q + 1));
    angle = 2.0 * atan2(sine, q[0]);
    factor = sine < 5e-7 ? 2.0 : angle / sine;
    for (i = 0; i < 3; ++i) {
        twist[3 + i] = factor * q[1 + i];
    }
}

/* Rotary joints by whole turns: near the wanted value, within limits; returns 1 if all limits hold. */
static int turn_near(double *q, const double *near)
{
    int i, inside = 1;
    for (i = 0; i < N; ++i) {
        if (!PRISMATIC[i]) {
            double high, low;
            q[i] -= TURN * floor((q[i] - near[i]) / TURN + 0.5);
            high = q[i] - UPPER[i] - LIMIT_TOLERANCE;
            low = LOWER[i] - LIMIT_TOLERANCE - q[i];
            if (high > 0.0) {
                q[i] -= TURN * ceil(high / TURN);
            } else if (low > 0.0) {
                q[i] += TURN * ceil(low / TURN);
            }
        }
        if (q[i] > UPPER[i] + LIMIT_TOLERANCE || q[i] < LOWER[i] - LIMIT_TOLERANCE) {
            inside = 0;
        }
    }
    return inside;
}
