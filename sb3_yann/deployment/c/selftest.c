/*
 * A test of @FILE@.c with known answers: it returns 0 and prints the largest error, in parts of an
 * input's range, or returns 1. Compile it with @FILE@.c, and run it on the target.
 */
#include <math.h>
#include <stddef.h>
#include <stdio.h>

#include "@FILE@.h"

#if YANN_EXPORT_ID != @EXPORT@u
#error "@FILE@.h is of another export than this file: export again"
#endif

#define N_POINTS @POINTS@
#define N_STEPS @STEPS@
#define N_STATES @STATES@ /* of the plant in the loop; 0 for readings that were recorded */
#define N_OUTPUTS @OUTPUTS@
#define N_LOADS @LOADS@

@VECTORS@

static double worst(const yann_real found[], const yann_real wanted[])
{
    double largest = 0.0;
    for (int i = 0; i < YANN_N_INPUTS; i++) {
        const double error = fabs((double)found[i] - (double)wanted[i]) / (double)range_of[i];
        if (!(error <= largest)) { /* NaN too */
            largest = error;
        }
    }
    return largest;
}

/* Where the MPC has no solution constraints give way, which costs digits. */
static double room_at(unsigned status)
{
    return status & YANN_OUTSIDE ? @ROOM_OUTSIDE@ : @ROOM_INSIDE@;
}

#if N_STATES > 0
static yann_real plant[N_STATES];

/* Add the plant's outputs to the readings. */
static void add_outputs(yann_real obs[])
{
    for (int i = 0; i < N_OUTPUTS; i++) {
        for (int j = 0; j < N_STATES; j++) {
            obs[i] += C_of_plant[i][j] * plant[j];
        }
    }
}

/* Move the plant by a step with an action and measured loads. */
static void move(const yann_real action[], const yann_real obs[])
{
    yann_real next[N_STATES];
    for (int a = 0; a < N_STATES; a++) {
        const yann_real *row = step_of_plant[a];
        next[a] = row[N_STATES + YANN_N_INPUTS + N_LOADS];
        for (int j = 0; j < N_STATES; j++) {
            next[a] += row[j] * plant[j];
        }
        for (int j = 0; j < YANN_N_INPUTS; j++) {
            next[a] += row[N_STATES + j] * action[j];
        }
#if N_LOADS > 0
        for (int j = 0; j < N_LOADS; j++) {
            next[a] += row[N_STATES + YANN_N_INPUTS + j] * obs[loads_of_plant[j]];
        }
#endif
    }
    for (int a = 0; a < N_STATES; a++) {
        plant[a] = next[a];
    }
    (void)obs;
}
#endif

int main(void)
{
    static yann_state state;
    yann_real action[YANN_N_INPUTS];
    double by_policy = 0.0, by_law = 0.0, by_step = 0.0, room = 0.0;
    int wrong = 0;
    for (int k = 0; k < N_POINTS; k++) {
        room = room_at(yann_policy(points[k], action));
        by_policy = fmax(by_policy, worst(action, policy[k]));
        wrong += !(worst(action, policy[k]) <= room);
        (void)yann_law(points[k], action);
        by_law = fmax(by_law, worst(action, law[k]));
        wrong += !(worst(action, law[k]) <= room);
    }
    yann_init(&state);
    room = @ROOM_IN_LOOP@;
#if N_STATES > 0
    for (int j = 0; j < N_STATES; j++) {
        plant[j] = start_of_plant[j];
    }
#endif
    for (int k = 0; k < N_STEPS; k++) {
        yann_real obs[YANN_N_OBS];
        for (int i = 0; i < YANN_N_OBS; i++) {
            obs[i] = readings[k][i];
        }
#if N_STATES > 0
        add_outputs(obs);
#endif
        if (lost[k]) {
            obs[0] = (yann_real)NAN;
        }
        if (starts_anew[k]) { /* with the plant's present input */
            yann_init(&state);
        }
        const unsigned found = yann_step(&state, obs, elapsed[k], (yann_mode)requests[k],
                                         starts_anew[k] ? action : NULL, action);
        room = fmax(room, room_at(found)); /* an output is held, and fades */
        by_step = fmax(by_step, worst(action, actions[k]));
        wrong += !(worst(action, actions[k]) <= room);
#if N_STATES > 0
        move(action, readings[k]);
#endif
        wrong += ((found ^ (unsigned)status[k]) & ~(unsigned)unsure[k]) != 0;
        wrong += state.mode != (yann_mode)modes[k];
    }
    printf("@FILE@: largest error %.2g (policy), %.2g (law), %.2g (steps) of the range; %s\n",
           by_policy, by_law, by_step, wrong ? "FAILED" : "passed");
    return wrong ? 1 : 0;
}
