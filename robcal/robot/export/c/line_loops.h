/* Lines of the chain that turn by the angles of several joints, or as the rocker of a four-bar. */
#pragma once
#include "vectors.h"

#define PI 3.14159265358979323846

/* Cosine of the angle between rocker and diagonal of a four-bar; beyond one it does not close. */
static double closing(const double *bar, double phi)
{
    double a = bar[0], b = bar[1], c = bar[2], g = bar[3], square = a * a + g * g - 2.0 * a * g * cos(phi);
    return (c * c + square - b * b) / (2.0 * c * sqrt(square));
}

static double rocker_angle(const double *bar, double phi)
{
    double apex = acos(fmin(fmax(closing(bar, phi), -1.0), 1.0));
    return PI + atan2(-bar[0] * sin(phi), bar[3] - bar[0] * cos(phi)) - bar[5] * apex;
}

static double rocker_slope(const double *bar, double phi)
{
    double a = bar[0], c = bar[2], psi = rocker_angle(bar, phi), coupler;
    if (!(fabs(closing(bar, phi)) < 1.0)) {
        return 0.0;
    }
    coupler = atan2(c * sin(psi) - a * sin(phi), bar[3] + c * cos(psi) - a * cos(phi));
    return a * sin(phi - coupler) / (c * sin(psi - coupler));
}

static const double *line_angles(const double *q, double *u)
{
    int i, k;
    for (i = 0; i < LINES; ++i) {
        u[i] = 0.0;
        for (k = 0; k < N; ++k) {
            u[i] += COUPLING[i][k] * q[k];
        }
    }
    for (i = 0; i < BARS; ++i) {
        u[BAR_LINE[i]] += rocker_angle(BAR[i], q[BAR_DRIVER[i]] + BAR[i][4]);
    }
    return u;
}

static void joint_twists(const double *q, const double *of_lines, double *J)
{
    int i, k, m;
    for (k = 0; k < 6 * N; ++k) {
        J[k] = 0.0;
    }
    for (i = 0; i < LINES; ++i) {
        for (k = 0; k < N; ++k) {
            for (m = 0; m < 6; ++m) {
                J[6 * k + m] += COUPLING[i][k] * of_lines[6 * i + m];
            }
        }
    }
    for (i = 0; i < BARS; ++i) {
        double slope = rocker_slope(BAR[i], q[BAR_DRIVER[i]] + BAR[i][4]);
        for (m = 0; m < 6; ++m) {
            J[6 * BAR_DRIVER[i] + m] += slope * of_lines[6 * BAR_LINE[i] + m];
        }
    }
}

static int loops_close(const double *q)
{
    int i;
    for (i = 0; i < BARS; ++i) {
        if (!(fabs(closing(BAR[i], q[BAR_DRIVER[i]] + BAR[i][4])) <= 1.0)) {
            return 0;
        }
    }
    return 1;
}

#define LOOPS_CLOSE(q) loops_close(q)
