/* First three axes of an arm whose axes 2 and 3 are parallel. */
#pragma once
#include "to_plane.h"

/* Axes 2 and 3 parallel: heights along them are axis 1's, the rest is a triangle. */
static int arm_angles(const double *goal, double arm[4][3])
{
    double u[3], c3[3], v[3], t[2], rest[3];
    int count = 0, i, k;
    subtract(goal, POINT[FIRST], u);
    subtract(CENTRE, POINT[FIRST], rest);
    subtract(CENTRE, POINT[FIRST + 2], c3);
    subtract(POINT[FIRST + 1], POINT[FIRST + 2], v);
    if (!to_plane(AXIS[FIRST], u, AXIS[FIRST + 1], dot(AXIS[FIRST + 1], rest), t)) {
        return 0;
    }
    for (i = 0; i < 2; ++i) {
        double seen[3], reach[3], t3[2];
        rotate_cs(AXIS[FIRST], cos(t[i]), sin(t[i]), u, seen);
        for (k = 0; k < 3; ++k) {
            reach[k] = POINT[FIRST][k] + seen[k] - POINT[FIRST + 1][k];
        }
        if (!to_distance(AXIS[FIRST + 2], c3, v, dot(reach, reach), t3)) {
            continue;
        }
        for (k = 0; k < 2; ++k) {
            double placed[3];
            rotate_cs(AXIS[FIRST + 2], cos(t3[k]), sin(t3[k]), c3, placed);
            subtract(placed, v, placed);
            arm[count][0] = -t[i];
            arm[count][1] = angle_between(AXIS[FIRST + 1], placed, reach);
            arm[count][2] = t3[k];
            ++count;
        }
    }
    return count;
}
