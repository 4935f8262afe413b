/* Nominal inverse by least squares from several start configurations. */
#pragma once
#include "least_squares.h"

int ROBOT(nominal_inverse)(const double base_T_tool[12], const double near[N], double q[N])
{
    double start[N], trial[N];
    int k, result = ROBOT(OUT_OF_REACH);
    memcpy(start, near, sizeof start);
    for (k = -1; k < STARTS; ++k) {
        memcpy(trial, k < 0 ? start : START[k], sizeof trial);
        if (refine(base_T_tool, trial, 80) && LOOPS_CLOSE(trial)) {
            int inside = turn_near(trial, start);
            if (inside || result == ROBOT(OUT_OF_REACH)) {
                memcpy(q, trial, sizeof trial);
                result = inside ? ROBOT(OK) : ROBOT(BEYOND_LIMITS);
            }
            if (inside) {
                return result;
            }
        }
    }
    if (result == ROBOT(OUT_OF_REACH)) {
        memcpy(q, start, sizeof start);
    }
    return result;
}
