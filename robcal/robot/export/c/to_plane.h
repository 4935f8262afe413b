/* Subproblem 4: a turn that brings a point into a plane (Elias, Wen, IK-Geo, 2022). */
#pragma once
#include "subproblems.h"

/* n . rot(w, t) u = h */
static int to_plane(const double *w, const double *u, const double *n, double h, double *t)
{
    double x[3], a = dot(n, u) - dot(w, u) * dot(w, n), b, middle, half;
    int possible = 1;
    cross(w, u, x);
    b = dot(n, x);
    middle = atan2(b, a);
    half = clipped_acos((h - dot(w, u) * dot(n, w)) / hypot(a, b), &possible);
    t[0] = middle + half;
    t[1] = middle - half;
    return possible;
}
