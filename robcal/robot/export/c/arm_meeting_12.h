/* First three axes of an arm whose axes 1 and 2 meet. */
#pragma once
#include "two_turns.h"

/* Axes 1 and 2 meet in SHOULDER: axis 3 makes the distance, the rest is two turns. */
static int arm_angles(const double *goal, double arm[4][3])
{
    double c3[3], v[3], reach[3], t3[2];
    int count = 0, i, k;
    subtract(CENTRE, POINT[FIRST + 2], c3);
    subtract(SHOULDER, POINT[FIRST + 2], v);
    subtract(goal, SHOULDER, reach);
    if (!to_distance(AXIS[FIRST + 2], c3, v, dot(reach, reach), t3)) {
        return 0;
    }
    for (i = 0; i < 2; ++i) {
        double placed[3], t1[2], t2[2];
        rotate_cs(AXIS[FIRST + 2], cos(t3[i]), sin(t3[i]), c3, placed);
        subtract(placed, v, placed);
        if (!two_turns(AXIS[FIRST], AXIS[FIRST + 1], placed, reach, t1, t2)) {
            continue;
        }
        for (k = 0; k < 2; ++k) {
            arm[count][0] = t1[k];
            arm[count][1] = t2[k];
            arm[count][2] = t3[i];
            ++count;
        }
    }
    return count;
}
