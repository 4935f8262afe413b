/* Closed-form inverse of an arm whose last three axes meet. */
#pragma once
#include ARM
#include "two_turns.h"

/* Branches of an arm whose last three axes meet in CENTRE; D = base_T_tool HOME^-1. Returns their number. */
static int closed_form(const double *D, const double *near, double branch[8][N])
{
    double goal[3], arm[4][3], pointing0[3], probe0[3];
    int count = 0, arms, b, k, i;
    turn(D, CENTRE, goal);
    goal[0] += D[3];
    goal[1] += D[7];
    goal[2] += D[11];
    arms = arm_angles(goal, arm);
    turn(D, AXIS[FIRST + 5], pointing0);
    turn(D, PROBE, probe0);
    for (b = 0; b < arms; ++b) {
        double t4[2], t5[2], pointing[3], probe[3], x[3];
        int wrists = 2;
        memcpy(pointing, pointing0, sizeof pointing);
        memcpy(probe, probe0, sizeof probe);
        for (i = 0; i < 3; ++i) {
            double c = cos(arm[b][i]), s = -sin(arm[b][i]);
            rotate_cs(AXIS[FIRST + i], c, s, pointing, x);
            memcpy(pointing, x, sizeof x);
            rotate_cs(AXIS[FIRST + i], c, s, probe, x);
            memcpy(probe, x, sizeof x);
        }
        cross(AXIS[FIRST + 3], pointing, x);
        if (dot(x, x) < 1e-18) {
            /* axes 4 and 6 aligned: axis 4 stays where it is */
            double kept[3];
            wrists = 1;
            t4[0] = near[FIRST + 3];
            rotate_cs(AXIS[FIRST + 3], cos(t4[0]), -sin(t4[0]), pointing, kept);
            t5[0] = angle_between(AXIS[FIRST + 4], AXIS[FIRST + 5], kept);
        } else if (!two_turns(AXIS[FIRST + 3], AXIS[FIRST + 4], AXIS[FIRST + 5], pointing, t4, t5)) {
            continue;
        }
        for (k = 0; k < wrists; ++k) {
            double y[3], z[3];
            double *q = branch[count++];
            rotate_cs(AXIS[FIRST + 3], cos(t4[k]), -sin(t4[k]), probe, y);
            rotate_cs(AXIS[FIRST + 4], cos(t5[k]), -sin(t5[k]), y, z);
            for (i = 0; i < FIRST; ++i) {
                q[i] = near[i];
            }
            q[FIRST] = arm[b][0];
            q[FIRST + 1] = arm[b][1];
            q[FIRST + 2] = arm[b][2];
            q[FIRST + 3] = t4[k];
            q[FIRST + 4] = t5[k];
            q[FIRST + 5] = angle_between(AXIS[FIRST + 5], PROBE, z);
        }
    }
    return count;
}
