/* First three axes of an arm whose axes 1 and 2 are parallel. */
#pragma once
#include "to_plane.h"

/* Axes 1 and 2 parallel: heights along them are axis 3's, the rest is a triangle. */
static int arm_angles(const double *goal, double arm[4][3])
{
    double c3[3], lift[3], reach[3], v[3], t3[2];
    int count = 0, i, k;
    subtract(CENTRE, POINT[FIRST + 2], c3);
    subtract(goal, POINT[FIRST + 2], lift);
    subtract(goal, POINT[FIRST], reach);
    subtract(POINT[FIRST], POINT[FIRST + 1], v);
    if (!to_plane(AXIS[FIRST + 2], c3, AXIS[FIRST], dot(AXIS[FIRST], lift), t3)) {
        return 0;
    }
    for (i = 0; i < 2; ++i) {
        double placed[3], t2[2];
        rotate_cs(AXIS[FIRST + 2], cos(t3[i]), sin(t3[i]), c3, placed);
        for (k = 0; k < 3; ++k) {
            placed[k] += POINT[FIRST + 2][k] - POINT[FIRST + 1][k];
        }
        if (!to_distance(AXIS[FIRST + 1], placed, v, dot(reach, reach), t2)) {
            continue;
        }
        for (k = 0; k < 2; ++k) {
            double elbow[3];
            rotate_cs(AXIS[FIRST + 1], cos(t2[k]), sin(t2[k]), placed, elbow);
            subtract(elbow, v, elbow);
            arm[count][0] = angle_between(AXIS[FIRST], elbow, reach);
            arm[count][1] = t2[k];
            arm[count][2] = t3[i];
            ++count;
        }
    }
    return count;
}
