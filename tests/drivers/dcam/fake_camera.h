/* An ORCA-Quest for the fake library: its properties, its ring, its trigger input, and what may go wrong.
 *
 * Pixels say where and when they were taken: four bits of the framestamp, six of the sensor row, six of the sensor column.
 * Row padding is 0xEE. A frame is in the ring an exposure and a readout after its trigger. Time is virtual (a wait jumps to
 * the next thing that happens) or real. The world outside acts through the functions named fakedcam_*. */
#include <math.h>
#include <pthread.h>
#include <stdlib.h>
#include <string.h>
#include <time.h>

#define PULSE_WIDTH 1e-3

enum { ST_BUSY = 1, ST_READY = 2, ST_STABLE = 3 };
enum { EV_FRAMEREADY = 2, EV_STOPPED = 16 };

/* Properties: access by state (S always for writable ones), value type, range, the values of a mode. */
enum { RO = 0, S = 0x20000, SR = 0x22000, SRB = 0x23000 };
enum { MODE = 1, LONG = 2, REAL = 3, ROUNDS = 0x800000 };
typedef struct { int32_t id, access, type; double min, max, step, initial; int legal[4]; double value; } Property;
enum {
    TRIGGERSOURCE, TRIGGERACTIVE, TRIGGER_MODE, TRIGGERPOLARITY, TRIGGERTIMES, TRIGGERDELAY, GLOBALEXPOSURE, EXPOSURETIME,
    TEMPERATURE, READOUTSPEED, SENSORMODE, BINNING, HPOS, HSIZE, VPOS, VSIZE, SUBARRAYMODE, READOUTTIME, CYCLIC, BLANKING,
    MININTERVAL, FRAMEINTERVAL, BITS, WIDTH, HEIGHT, ROWBYTES, PIXELTYPE, FRAMEBYTES, BUNDLE, DEFECT, COEFF, OFFSET, N_PROPS
};
static const Property TABLE[N_PROPS] = {
    [TRIGGERSOURCE] = {0x00100110, SRB, MODE, 1, 4, 1, 1, {1, 2, 3, 4}},
    [TRIGGERACTIVE] = {0x00100120, SR, MODE, 1, 3, 1, 1, {1, 2, 3}},
    [TRIGGER_MODE] = {0x00100210, SR, MODE, 1, 6, 1, 1, {1, 6}},
    [TRIGGERPOLARITY] = {0x00100220, SRB, MODE, 1, 2, 1, 1, {1, 2}},
    [TRIGGERTIMES] = {0x00100240, SRB, LONG, 1, 10000, 1, 1},
    [TRIGGERDELAY] = {0x00100260, SRB, REAL, 0, 10, 1e-6, 0},
    [GLOBALEXPOSURE] = {0x001F0300, S, MODE, 3, 5, 1, 3, {3, 5}},
    [EXPOSURETIME] = {0x001F0110, SRB, REAL | ROUNDS, 7.2e-6, 1800, 1e-8, 8.2944e-3},
    [TEMPERATURE] = {0x00200310, RO, REAL, -50, 100, 0.1, -20},
    [READOUTSPEED] = {0x00400110, S, MODE, 1, 2, 1, 2, {1, 2}},
    [SENSORMODE] = {0x00400210, S, MODE, 1, 18, 1, 1, {1, 12, 18}},
    [BINNING] = {0x00401110, S, MODE, 1, 4, 1, 1, {1, 2, 4}},
    [HPOS] = {0x00402110, S, LONG | ROUNDS, 0, 0, 4, 0},
    [HSIZE] = {0x00402120, S, LONG | ROUNDS, 4, 0, 4, 0},
    [VPOS] = {0x00402130, S, LONG | ROUNDS, 0, 0, 4, 0},
    [VSIZE] = {0x00402140, S, LONG | ROUNDS, 4, 0, 4, 0},
    [SUBARRAYMODE] = {0x00402150, S, MODE, 1, 2, 1, 1, {1, 2}},
    [READOUTTIME] = {0x00403010, RO, REAL},
    [CYCLIC] = {0x00403020, RO, REAL},
    [BLANKING] = {0x00403030, RO, REAL},
    [MININTERVAL] = {0x00403050, RO, REAL},
    [FRAMEINTERVAL] = {0x00403820, RO, REAL},
    [BITS] = {0x00420130, S, MODE, 8, 16, 4, 16, {8, 12, 16}},
    [WIDTH] = {0x00420210, RO, LONG},
    [HEIGHT] = {0x00420220, RO, LONG},
    [ROWBYTES] = {0x00420230, RO, LONG},
    [PIXELTYPE] = {0x00420270, S, MODE, 1, 2, 1, 2, {1, 2}},
    [FRAMEBYTES] = {0x00420340, RO, LONG},
    [BUNDLE] = {0x00421010, RO, MODE, 1, 2, 1, 1, {1, 2}},
    [DEFECT] = {0x00470010, SRB, MODE, 1, 2, 1, 2, {1, 2}},
    [COEFF] = {0x00FFE010, RO, REAL, 0, 1, 0, 0.107},
    [OFFSET] = {0x00FFE020, RO, REAL, 0, 1000, 0, 200},
};

/* What the outside can do to the camera and its library. */
static const char *const FAULTS[] = {"no_camera", "unplugged", "drop", "report_loss", "pad", "first_stamp", "start_polls",
                                     "overrun_in_lock", "swallow_events", "refuse", "no_memory", "no_stopped_event"};
enum { NO_CAMERA, UNPLUGGED, DROP, REPORT_LOSS, PAD, FIRST_STAMP, START_POLLS, OVERRUN_IN_LOCK, SWALLOW, REFUSE, NO_MEMORY, NO_STOPPED_EVENT, N_FAULTS };

enum { MAX_PULSES = 4096 };
static struct {
    Property props[N_PROPS];
    int overridden[N_PROPS], faults[N_FAULTS];
    double override[N_PROPS];
    int sensor_rows, sensor_cols, devices;
    int session, opened, waiting_open, status, mode, polls, waiters, pending;
    int slots, count, exposed, accepted;
    uint8_t **ring;
    int32_t *stamps;
    double *times, last_edge, started, boot, virtual_now; /* virtual_now 0: real time */
    double pulses[MAX_PULSES];
    int n_pulses, seen;
    struct { double edge, ready; int stamp; } flying[4]; /* exposed, not yet read out */
    int n_flying;
    char camera, wait; /* their addresses are the handles */
} fake;
static pthread_mutex_t lock = PTHREAD_MUTEX_INITIALIZER;
static pthread_cond_t changed = PTHREAD_COND_INITIALIZER;

static double now(void) {
    if (fake.virtual_now > 0) return fake.virtual_now;
    struct timespec t;
    clock_gettime(CLOCK_REALTIME, &t);
    return (double)t.tv_sec + 1e-9 * (double)t.tv_nsec;
}

static double get(int p) {
    if (fake.overridden[p]) return fake.override[p];
    int subarray = fake.props[SUBARRAYMODE].value == 2, binning = (int)fake.props[BINNING].value;
    int rows = subarray ? (int)fake.props[VSIZE].value : fake.sensor_rows;
    int cols = subarray ? (int)fake.props[HSIZE].value : fake.sensor_cols;
    double line = fake.props[READOUTSPEED].value == 1 ? 172.8e-6 : 7.2e-6, exposure = fake.props[EXPOSURETIME].value;
    switch (p) {
    case READOUTTIME: return rows / 2 * line;
    case BLANKING: return (rows / 2 + 5) * line;
    case CYCLIC: case MININTERVAL: return exposure + (rows / 2 + 5) * line;
    case FRAMEINTERVAL: return fmax(exposure, (rows / 2 + 5) * line);
    case WIDTH: return cols / binning;
    case HEIGHT: return rows / binning;
    case ROWBYTES: return cols / binning * 2 + fake.faults[PAD];
    case FRAMEBYTES: return get(ROWBYTES) * get(HEIGHT);
    default: return fake.props[p].value;
    }
}

static int capturing(void) { return fake.status == ST_BUSY && fake.polls >= fake.faults[START_POLLS]; }

static void deliver(void) { /* the oldest exposed frame, into the ring */
    int slot = fake.count % fake.slots, rows = (int)get(HEIGHT), cols = (int)get(WIDTH), stride = (int)get(ROWBYTES);
    int subarray = fake.props[SUBARRAYMODE].value == 2, binning = (int)fake.props[BINNING].value;
    int row0 = subarray ? (int)fake.props[VPOS].value : 0, col0 = subarray ? (int)fake.props[HPOS].value : 0;
    int stamp = fake.flying[0].stamp;
    for (int r = 0; r < rows; r++) {
        uint8_t *row = fake.ring[slot] + (size_t)r * (size_t)stride;
        memset(row, 0xEE, (size_t)stride);
        for (int c = 0; c < cols; c++) {
            unsigned v = ((unsigned)stamp & 15u) << 12 | ((unsigned)(row0 + r * binning) & 63u) << 6 | ((unsigned)(col0 + c * binning) & 63u);
            row[2 * c] = (uint8_t)(v & 255u);
            row[2 * c + 1] = (uint8_t)(v >> 8);
        }
    }
    fake.stamps[slot] = stamp;
    fake.times[slot] = fake.flying[0].edge - fake.boot; /* the camera's clock starts when it is switched on */
    memmove(fake.flying, fake.flying + 1, sizeof fake.flying - sizeof *fake.flying);
    fake.n_flying--;
    fake.count++;
    if (fake.faults[SWALLOW] > 0) fake.faults[SWALLOW]--;
    else fake.pending |= EV_FRAMEREADY;
    if (fake.mode == 0 && fake.count == fake.slots) { fake.status = ST_READY; fake.pending |= EV_STOPPED; }
    pthread_cond_broadcast(&changed);
}

static void expose(double edge) {
    int stamp = fake.faults[FIRST_STAMP] + fake.exposed++;
    fake.last_edge = edge;
    if (fake.n_flying == 4) deliver();
    if (fake.faults[DROP] > 0) { fake.faults[DROP]--; return; }
    fake.flying[fake.n_flying].edge = edge;
    fake.flying[fake.n_flying].ready = edge + get(EXPOSURETIME) + get(READOUTTIME);
    fake.flying[fake.n_flying++].stamp = stamp;
}

static double next_edge(void) {
    if (fake.seen < fake.n_pulses) return fake.pulses[fake.seen] + (fake.props[TRIGGERPOLARITY].value == 2 ? 0 : PULSE_WIDTH);
    if (!capturing() || fake.props[TRIGGERSOURCE].value != 1 || (fake.mode == 0 && fake.exposed >= fake.slots)) return INFINITY;
    return fake.started + fake.exposed * get(FRAMEINTERVAL);
}

static double next_ready(void) { return fake.n_flying ? fake.flying[0].ready : INFINITY; }

static void trigger(double edge) { /* an edge on the input, or of the free run */
    if (fake.seen < fake.n_pulses) {
        fake.seen++;
        if (!capturing() || fake.props[TRIGGERSOURCE].value != 2 || edge - fake.last_edge < get(MININTERVAL) - 1e-6) return;
        if (++fake.accepted % (int)fake.props[TRIGGERTIMES].value) return;
        edge += fake.props[TRIGGERDELAY].value;
    }
    expose(edge);
}

static void catch_up(void) {
    while (fmin(next_edge(), next_ready()) <= now()) {
        if (next_ready() <= next_edge()) deliver();
        else trigger(next_edge());
    }
}

static int supported_events(void) { return EV_FRAMEREADY | (fake.faults[NO_STOPPED_EVENT] ? 0 : EV_STOPPED); }

static void release(void) {
    for (int i = 0; i < fake.slots; i++) free(fake.ring[i]);
    free(fake.ring); free(fake.stamps); free(fake.times);
    fake.ring = NULL; fake.stamps = NULL; fake.times = NULL; fake.slots = fake.n_flying = 0;
    fake.status = ST_STABLE;
}

static void stop(void) {
    if (fake.status != ST_BUSY) return;
    fake.status = ST_READY;
    fake.n_flying = 0;
    fake.pending |= EV_STOPPED;
    pthread_cond_broadcast(&changed);
}

void fakedcam_reset(int devices, int rows, int cols, double virtual_now) {
    pthread_mutex_lock(&lock);
    if (fake.slots) release();
    memset(&fake, 0, sizeof fake);
    fake.virtual_now = virtual_now; fake.boot = now() - 77.25;
    fake.devices = devices; fake.sensor_rows = rows; fake.sensor_cols = cols; fake.status = ST_STABLE;
    memcpy(fake.props, TABLE, sizeof TABLE);
    for (int p = 0; p < N_PROPS; p++) fake.props[p].value = TABLE[p].initial;
    fake.props[HPOS].max = cols - 4; fake.props[VPOS].max = rows - 4;
    fake.props[HSIZE].max = fake.props[HSIZE].value = cols; fake.props[VSIZE].max = fake.props[VSIZE].value = rows;
    pthread_mutex_unlock(&lock);
}

int fakedcam_fault(const char *name, int value) {
    for (int i = 0; i < N_FAULTS; i++) if (!strcmp(name, FAULTS[i])) { fake.faults[i] = value; return 1; }
    return 0;
}

static int find(int32_t id) {
    for (int p = 0; p < N_PROPS; p++) if (TABLE[p].id == id) return p;
    return -1;
}

int fakedcam_override(int32_t id, double value) { /* the property reads so from now on, whatever is set */
    int p = find(id);
    if (p < 0) return 0;
    fake.overridden[p] = 1;
    fake.override[p] = value;
    return 1;
}

int fakedcam_preset(int32_t id, double value) { /* as another program left it */
    int p = find(id);
    if (p < 0) return 0;
    fake.props[p].value = value;
    return 1;
}

double fakedcam_value(int32_t id) { return get(find(id)); }

int fakedcam_exposed(void) { return fake.exposed; }

double fakedcam_now(void) { return now(); }

void fakedcam_sleep(double seconds) { /* in virtual time */
    pthread_mutex_lock(&lock);
    fake.virtual_now += seconds;
    catch_up();
    pthread_mutex_unlock(&lock);
}

int fakedcam_pulse(double rise) { /* on the trigger input, some time from now on and after those before */
    pthread_mutex_lock(&lock);
    int room = fake.n_pulses < MAX_PULSES;
    if (room) fake.pulses[fake.n_pulses++] = rise;
    pthread_cond_broadcast(&changed);
    pthread_mutex_unlock(&lock);
    return room;
}

void fakedcam_stop(void) { pthread_mutex_lock(&lock); stop(); pthread_mutex_unlock(&lock); }

int fakedcam_live(void) { return fake.session + fake.opened + fake.waiting_open + (fake.slots > 0); }

int fakedcam_waiters(void) { return fake.waiters; }
