#ifndef YANN_H
#define YANN_H
/*
@ABOUT@
 *
 * yann_policy() and yann_law() have no memory. yann_step() is one step of the plant's controller:
 * it checks the readings, falls back on the MPC's law or holds the output, and goes on from where
 * the output was. Call yann_init() before the first step. No memory is allocated, nothing but libm
 * is called, every loop is bounded. Do not compile with -ffast-math: NaN must stay NaN.
 */

#ifdef __cplusplus
extern "C" {
#endif

/* Which export this is: files of two exports do not compile. */
#define YANN_EXPORT_ID @EXPORT@u

@SIZES@

typedef @REAL@ yann_real;

/* Who acts. */
typedef enum { YANN_POLICY = 0, YANN_MPC = 1, YANN_MANUAL = 2 } yann_mode;

/* What a step found; the first four are faults. */
#define YANN_NOT_FINITE 1u   /* a reading, or manual where it counts, is NaN or infinite */
#define YANN_OUT_OF_RANGE 2u /* a reading is beyond its limits */
#define YANN_FROZEN 4u       /* a reading stays the same while others, or the output, move */
#define YANN_LATE 8u         /* too much time has passed since the last step */
#define YANN_OUTSIDE 16u     /* the MPC has no solution here */
#define YANN_NETWORK 32u     /* a network put out what is no number; the law acted */

/* What is kept between steps. */
typedef struct {
    yann_real good[YANN_N_OBS]; /* the last good readings */
    yann_real last[YANN_N_OBS]; /* the last readings */
    yann_real output[YANN_N_INPUTS];
    yann_real anchor[YANN_N_INPUTS]; /* what came out when a reading moved last */
    yann_real bump[YANN_N_INPUTS]; /* what a change of who acts must still make up for */
@MEMORY@    int same[YANN_N_OBS];   /* for how many steps a reading has not moved */
    int absent[YANN_N_OBS]; /* for how many steps it has been missing */
    int moved; /* whether a reading moved */
    int faults, sound, left;
    int started;
    yann_mode mode;      /* who acted at the last step */
    unsigned long steps; /* how many there were */
    unsigned long steps_of_mode[3];
    unsigned long changes;  /* of who acts */
    unsigned long found[6]; /* how many steps found each of the above, from NOT_FINITE on */
} yann_state;

/* Begin at the operating point. */
void yann_init(yann_state *state);

/*
 * One step: write the action, return what was found (0 for nothing).
 *   elapsed  time since the last step in units of dt; 0 or less where it is not known
 *   request  what the operator wants
 *   manual   the operator's output, which acts where he requests it; or NULL to hold it. At the
 *            first step: the plant's present input, whoever acts; the output goes on from it
 */
unsigned yann_step(yann_state *state, const yann_real obs[YANN_N_OBS], yann_real elapsed,
                   yann_mode request, const yann_real *manual, yann_real action[YANN_N_INPUTS]);

/* The policy, and the MPC's law alone, at what they see; they return what they found. */
unsigned yann_policy(const yann_real seen[YANN_N_SEEN], yann_real action[YANN_N_INPUTS]);
unsigned yann_law(const yann_real seen[YANN_N_SEEN], yann_real action[YANN_N_INPUTS]);

#ifdef __cplusplus
}
#endif
#endif
