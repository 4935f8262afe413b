/* Paden-Kahan subproblem 2: turns about two lines that meet. */
#pragma once
#include "subproblems.h"

/* rot(w1, t1) rot(w2, t2) u = v; returns 0 if impossible */
static int two_turns(const double *w1, const double *w2, const double *u, const double *v, double *t1, double *t2)
{
    double c = dot(w1, w2), a = dot(w1, v), b = dot(w2, u), s2 = 1.0 - c * c, uu = dot(u, u), x[3], z[3];
    double alpha = (a - c * b) / s2, beta = (b - c * a) / s2;
    double gamma2 = (uu - alpha * alpha - beta * beta - 2.0 * alpha * beta * c) / s2, gamma;
    int k, i;
    if (!(gamma2 >= -EDGE * uu / s2)) {
        return 0;
    }
    gamma = gamma2 > 0.0 ? sqrt(gamma2) : 0.0;
    cross(w1, w2, x);
    for (k = 0; k < 2; ++k) {
        double g = k ? -gamma : gamma;
        for (i = 0; i < 3; ++i) {
            z[i] = alpha * w1[i] + beta * w2[i] + g * x[i];
        }
        t2[k] = angle_between(w2, u, z);
        t1[k] = angle_between(w1, z, v);
    }
    return 1;
}
