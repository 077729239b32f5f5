/*
@ABOUT@
 *
 * The FMI 2.0 interface for co-simulation around yann_step(). The importer sets the inputs of a
 * sampling instant, may read the outputs that follow from them at once, and calls fmi2DoStep()
 * with the controller's dt, which makes the step once and for all. After it the outputs stay as
 * they are until an input is set.
 */
#include <math.h>
#include <stddef.h>
#include <string.h>

#include "@FILE@.h"
#include "@FILE@_fmi2.h"

/* Value references: obs, elapsed, manual and command among the real ones, in this order. */
#define N_OBS YANN_N_OBS
#define N_INPUTS YANN_N_INPUTS
#define AT_ELAPSED N_OBS
#define AT_MANUAL (N_OBS + 1)
#define AT_COMMAND (AT_MANUAL + N_INPUTS)
#define N_REALS (AT_COMMAND + N_INPUTS)
enum { AT_REQUEST, AT_STATUS, AT_MODE, N_INTEGERS };
enum { AT_HAS_MANUAL, N_BOOLEANS };

static const fmi2Real step_size = @DT@; /* 0 where it is not known */
static const fmi2Real first_obs[N_OBS] = @REST@;

typedef struct {
    fmi2Real real[N_REALS];
    fmi2Integer integer[N_INTEGERS];
    fmi2Boolean boolean[N_BOOLEANS];
    yann_state before, after; /* of the step at this instant */
    int known;                /* whether `after` and the outputs follow from the inputs */
    int made;                 /* whether fmi2DoStep() has made that step */
    fmi2String name;
    fmi2CallbackFunctions callbacks;
} instance;

static void complain(instance *own, fmi2String text)
{
    if (own->callbacks.logger != NULL) {
        own->callbacks.logger(own->callbacks.componentEnvironment, own->name, fmi2Error,
                              "logStatusError", "%s", text);
    }
}

static void begin(instance *own)
{
    memset(own->real, 0, sizeof own->real);
    memset(own->integer, 0, sizeof own->integer);
    memset(own->boolean, 0, sizeof own->boolean);
    memcpy(own->real, first_obs, sizeof first_obs);
    yann_init(&own->before);
    own->known = own->made = 0;
}

/* The step that the inputs of this instant ask for; it does not count before fmi2DoStep(). */
static void look(instance *own)
{
    yann_real obs[N_OBS], manual[N_INPUTS], action[N_INPUTS];
    if (own->known) {
        return;
    }
    for (int i = 0; i < N_OBS; i++) {
        obs[i] = (yann_real)own->real[i];
    }
    for (int i = 0; i < N_INPUTS; i++) {
        manual[i] = (yann_real)own->real[AT_MANUAL + i];
    }
    own->after = own->before;
    own->integer[AT_STATUS] = (fmi2Integer)yann_step(
        &own->after, obs, (yann_real)own->real[AT_ELAPSED], (yann_mode)own->integer[AT_REQUEST],
        own->boolean[AT_HAS_MANUAL] ? manual : NULL, action);
    own->integer[AT_MODE] = (fmi2Integer)own->after.mode;
    for (int i = 0; i < N_INPUTS; i++) {
        own->real[AT_COMMAND + i] = action[i];
    }
    own->known = 1;
}

EXPORT const char *FMI(fmi2GetTypesPlatform)(void) { return "default"; }

EXPORT const char *FMI(fmi2GetVersion)(void) { return "2.0"; }

EXPORT fmi2Status FMI(fmi2SetDebugLogging)(fmi2Component c, fmi2Boolean on, size_t n,
                                           const fmi2String categories[])
{
    (void)c, (void)on, (void)n, (void)categories;
    return fmi2OK;
}

EXPORT fmi2Component FMI(fmi2Instantiate)(fmi2String name, fmi2Type type, fmi2String guid,
                                          fmi2String resources,
                                          const fmi2CallbackFunctions *callbacks,
                                          fmi2Boolean visible, fmi2Boolean logging)
{
    (void)resources, (void)visible, (void)logging;
    if (callbacks == NULL || callbacks->allocateMemory == NULL || callbacks->freeMemory == NULL) {
        return NULL;
    }
    instance *own = callbacks->allocateMemory(1, sizeof *own);
    if (own == NULL) {
        return NULL;
    }
    own->callbacks = *callbacks;
    own->name = "@FILE@";
    if (type != fmi2CoSimulation || guid == NULL || strcmp(guid, "@GUID@") != 0) {
        complain(own, "This FMU is for co-simulation, and modelDescription.xml must be its own.");
        callbacks->freeMemory(own);
        return NULL;
    }
    (void)name; /* it may not outlive this call */
    begin(own);
    return own;
}

EXPORT void FMI(fmi2FreeInstance)(fmi2Component c)
{
    if (c != NULL) {
        ((instance *)c)->callbacks.freeMemory(c);
    }
}

EXPORT fmi2Status FMI(fmi2SetupExperiment)(fmi2Component c, fmi2Boolean with_tolerance,
                                           fmi2Real tolerance, fmi2Real start,
                                           fmi2Boolean with_stop, fmi2Real stop)
{
    (void)c, (void)with_tolerance, (void)tolerance, (void)start, (void)with_stop, (void)stop;
    return fmi2OK;
}

EXPORT fmi2Status FMI(fmi2EnterInitializationMode)(fmi2Component c) { return (void)c, fmi2OK; }

EXPORT fmi2Status FMI(fmi2ExitInitializationMode)(fmi2Component c) { return (void)c, fmi2OK; }

EXPORT fmi2Status FMI(fmi2Terminate)(fmi2Component c) { return (void)c, fmi2OK; }

EXPORT fmi2Status FMI(fmi2Reset)(fmi2Component c)
{
    begin(c);
    return fmi2OK;
}

/* Getting and setting, alike for three types: of so many entries the first are inputs. */
#define ACCESS(Type, type, entries, inputs)                                                        \
    EXPORT fmi2Status FMI(fmi2Get##Type)(fmi2Component c, const fmi2ValueReference at[], size_t n, \
                                         fmi2##Type value[])                                       \
    {                                                                                              \
        instance *own = c;                                                                         \
        look(own);                                                                                 \
        for (size_t i = 0; i < n; i++) {                                                           \
            if (at[i] >= (entries)) {                                                              \
                complain(own, "No such variable.");                                                \
                return fmi2Error;                                                                  \
            }                                                                                      \
            value[i] = own->type[at[i]];                                                           \
        }                                                                                          \
        return fmi2OK;                                                                             \
    }                                                                                              \
    EXPORT fmi2Status FMI(fmi2Set##Type)(fmi2Component c, const fmi2ValueReference at[], size_t n, \
                                         const fmi2##Type value[])                                 \
    {                                                                                              \
        instance *own = c;                                                                         \
        for (size_t i = 0; i < n; i++) {                                                           \
            if (at[i] >= (inputs)) {                                                               \
                complain(own, "No such input.");                                                   \
                return fmi2Error;                                                                  \
            }                                                                                      \
            own->type[at[i]] = value[i];                                                           \
            own->known = own->made = 0;                                                            \
        }                                                                                          \
        return fmi2OK;                                                                             \
    }
ACCESS(Real, real, (fmi2ValueReference)N_REALS, (fmi2ValueReference)AT_COMMAND)
ACCESS(Integer, integer, (fmi2ValueReference)N_INTEGERS, (fmi2ValueReference)AT_STATUS)
ACCESS(Boolean, boolean, (fmi2ValueReference)N_BOOLEANS, (fmi2ValueReference)N_BOOLEANS)

EXPORT fmi2Status FMI(fmi2DoStep)(fmi2Component c, fmi2Real now, fmi2Real step, fmi2Boolean kept)
{
    instance *own = c;
    (void)now, (void)kept;
    if (step_size > 0.0 && fabs(step - step_size) > 1e-6 * step_size) {
        complain(own, "The communication step must be the controller's dt, @DT@.");
        return fmi2Error;
    }
    if (own->made) {
        own->known = 0; /* the inputs are those of the step before */
    }
    look(own);
    own->before = own->after;
    own->made = 1;
    return fmi2OK;
}

/* ---- What modelDescription.xml says that there is not ---- */

static fmi2Status not_there(fmi2Component c)
{
    complain(c, "modelDescription.xml does not offer this function.");
    return fmi2Error;
}

EXPORT fmi2Status FMI(fmi2GetString)(fmi2Component c, const fmi2ValueReference at[], size_t n,
                                     fmi2String value[])
{
    (void)at, (void)value;
    return n == 0 ? fmi2OK : not_there(c);
}

EXPORT fmi2Status FMI(fmi2SetString)(fmi2Component c, const fmi2ValueReference at[], size_t n,
                                     const fmi2String value[])
{
    (void)at, (void)value;
    return n == 0 ? fmi2OK : not_there(c);
}

EXPORT fmi2Status FMI(fmi2GetFMUstate)(fmi2Component c, fmi2FMUstate *state)
{
    return (void)state, not_there(c);
}

EXPORT fmi2Status FMI(fmi2SetFMUstate)(fmi2Component c, fmi2FMUstate state)
{
    return (void)state, not_there(c);
}

EXPORT fmi2Status FMI(fmi2FreeFMUstate)(fmi2Component c, fmi2FMUstate *state)
{
    return (void)state, not_there(c);
}

EXPORT fmi2Status FMI(fmi2SerializedFMUstateSize)(fmi2Component c, fmi2FMUstate state, size_t *size)
{
    return (void)state, (void)size, not_there(c);
}

EXPORT fmi2Status FMI(fmi2SerializeFMUstate)(fmi2Component c, fmi2FMUstate state, fmi2Byte bytes[],
                                             size_t size)
{
    return (void)state, (void)bytes, (void)size, not_there(c);
}

EXPORT fmi2Status FMI(fmi2DeSerializeFMUstate)(fmi2Component c, const fmi2Byte bytes[], size_t size,
                                               fmi2FMUstate *state)
{
    return (void)state, (void)bytes, (void)size, not_there(c);
}

EXPORT fmi2Status FMI(fmi2GetDirectionalDerivative)(fmi2Component c,
                                                    const fmi2ValueReference unknown[], size_t n,
                                                    const fmi2ValueReference known[], size_t m,
                                                    const fmi2Real dv[], fmi2Real du[])
{
    (void)unknown, (void)n, (void)known, (void)m, (void)dv, (void)du;
    return not_there(c);
}

EXPORT fmi2Status FMI(fmi2SetRealInputDerivatives)(fmi2Component c, const fmi2ValueReference at[],
                                                   size_t n, const fmi2Integer order[],
                                                   const fmi2Real value[])
{
    return (void)at, (void)n, (void)order, (void)value, not_there(c);
}

EXPORT fmi2Status FMI(fmi2GetRealOutputDerivatives)(fmi2Component c, const fmi2ValueReference at[],
                                                    size_t n, const fmi2Integer order[],
                                                    fmi2Real value[])
{
    return (void)at, (void)n, (void)order, (void)value, not_there(c);
}

EXPORT fmi2Status FMI(fmi2CancelStep)(fmi2Component c) { return not_there(c); }

/* A step is done when fmi2DoStep() returns: there is never a pending one to ask about. */
#define STATUS(Name, type)                                                                         \
    EXPORT fmi2Status FMI(fmi2Get##Name##Status)(fmi2Component c, const fmi2StatusKind kind,       \
                                                 type *value)                                      \
    {                                                                                              \
        return (void)c, (void)kind, (void)value, fmi2Discard;                                      \
    }
EXPORT fmi2Status FMI(fmi2GetStatus)(fmi2Component c, const fmi2StatusKind kind, fmi2Status *value)
{
    return (void)c, (void)kind, (void)value, fmi2Discard;
}
STATUS(Real, fmi2Real)
STATUS(Integer, fmi2Integer)
STATUS(Boolean, fmi2Boolean)
STATUS(String, fmi2String)
