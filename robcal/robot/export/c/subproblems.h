/* Paden-Kahan subproblems 1 and 3 (Murray, Li, Sastry, A Mathematical Introduction to Robotic Manipulation, 1994, 3.3). */
#pragma once
#include "vectors.h"

/* Rodrigues: u turned about w */
static void rotate_cs(const double *w, double c, double s, const double *u, double *v)
{
    double d = dot(w, u) * (1.0 - c), x[3];
    cross(w, u, x);
    v[0] = c * u[0] + s * x[0] + d * w[0];
    v[1] = c * u[1] + s * x[1] + d * w[1];
    v[2] = c * u[2] + s * x[2] + d * w[2];
}

static void subtract(const double *a, const double *b, double *c)
{
    c[0] = a[0] - b[0];
    c[1] = a[1] - b[1];
    c[2] = a[2] - b[2];
}

static double clipped_acos(double x, int *possible)
{
    if (!(fabs(x) <= 1.0 + EDGE)) {
        *possible = 0;
        return 0.0;
    }
    return acos(x > 1.0 ? 1.0 : (x < -1.0 ? -1.0 : x));
}

/* angle about w from u to v */
static double angle_between(const double *w, const double *u, const double *v)
{
    double x[3];
    cross(u, v, x);
    return atan2(dot(w, x), dot(u, v) - dot(w, u) * dot(w, v));
}

/* |v - rot(w, t) u|^2 = d2 */
static int to_distance(const double *w, const double *u, const double *v, double d2, double *t)
{
    double along = dot(w, u) - dot(w, v), uu = dot(u, u) - dot(w, u) * dot(w, u);
    double vv = dot(v, v) - dot(w, v) * dot(w, v), middle = angle_between(w, u, v), half;
    int possible = 1;
    half = clipped_acos((uu + vv - d2 + along * along) / (2.0 * sqrt(uu * vv)), &possible);
    t[0] = middle + half;
    t[1] = middle - half;
    return possible;
}
