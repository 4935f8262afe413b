/* Nominal inverse from the branches of the closed form. */
#pragma once
#include CLOSED_FORM
#include "least_squares.h"

int ROBOT(nominal_inverse)(const double base_T_tool[12], const double near[N], double q[N])
{
    double shifted[12], D[12], branch[8][N], start[N], T[12], r[6], best = HUGE_VAL;
    int count, b, i, chosen = -1;
    memcpy(start, near, sizeof start);
    memcpy(q, near, sizeof start);
    memcpy(shifted, base_T_tool, sizeof shifted);
#if FIRST
    /* a track under the arm stays where it is */
    for (i = 0; i < 3; ++i) {
        shifted[4 * i + 3] -= near[0] * AXIS[0][i];
    }
#endif
    multiply(shifted, HOME_INVERSE, D);
    count = closed_form(D, start, branch);
    for (b = 0; b < count; ++b) {
        double distance = 0.0;
        if (!turn_near(branch[b], start)) {
            continue;
        }
        for (i = 0; i < N; ++i) {
            distance += (branch[b][i] - start[i]) * (branch[b][i] - start[i]);
        }
        if (distance < best) {
            best = distance;
            chosen = b;
        }
    }
    if (chosen < 0) {
        return count ? ROBOT(BEYOND_LIMITS) : ROBOT(OUT_OF_REACH);
    }
    memcpy(q, branch[chosen], sizeof start);
    chain(q, T, 0);
    difference(T, base_T_tool, r);
    if (weighted(r) > 1e-22 && !refine(base_T_tool, q, 12)) {
        return ROBOT(OUT_OF_REACH);
    }
    return ROBOT(OK);
}
