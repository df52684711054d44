/* The world outside the fake camera: time, its trigger cable, faults, and what a test may look at. The driver knows none of
 * these functions; all begin with fakedcam_. */

void fakedcam_reset(int devices, int rows, int cols, double virtual_now) {
    pthread_mutex_lock(&lock);
    if (fake.slots) release();
    int n_handles = fake.n_handles;
    memset(&fake, 0, sizeof fake);
    fake.n_handles = n_handles;
    fake.virtual_now = virtual_now; fake.boot = now() - 77.25; fake.looked = now();
    fake.devices = devices; fake.sensor_rows = rows; fake.sensor_cols = cols; fake.status = ST_STABLE;
    memcpy(fake.props, TABLE, sizeof TABLE);
    for (int p = 0; p < N_PROPS; p++) fake.props[p].value = TABLE[p].initial;
    fake.props[HPOS].max = cols - 4; fake.props[VPOS].max = rows - 4;
    fake.props[HSIZE].max = fake.props[HSIZE].value = cols; fake.props[VSIZE].max = fake.props[VSIZE].value = rows;
    pthread_mutex_unlock(&lock);
}

#define LOCKED(type, expression) do { pthread_mutex_lock(&lock); type answer = (expression); pthread_mutex_unlock(&lock); \
    return answer; } while (0)

static int set_fault(const char *name, int value) {
    for (int i = 0; i < N_FAULTS; i++) if (!strcmp(name, FAULTS[i])) { fake.faults[i] = value; return 1; }
    return 0;
}

int fakedcam_fault(const char *name, int value) { LOCKED(int, set_fault(name, value)); }

static int slot_of(const char *call) { /* where calls of that name are counted */
    for (int i = 0; i < MAX_CALLS; i++) {
        if (!fake.calls[i].name) fake.calls[i].name = call;
        if (!strcmp(fake.calls[i].name, call)) return i;
    }
    abort();
}

static int32_t called(const char *call) { /* the error that this call must answer with, or 0 */
    int i = slot_of(call);
    fake.calls[i].count++;
    if (fake.calls[i].fail_in == 0 || --fake.calls[i].fail_in > 0) return 0;
    if (fake.calls[i].code == NOCONNECTION) fake.faults[UNPLUGGED] = 1;
    return fake.calls[i].code;
}

static int set_failure(const char *call, int in, int32_t code) {
    static char names[MAX_CALLS][64];
    int i = slot_of(call);
    if (fake.calls[i].name == call) fake.calls[i].name = strncpy(names[i], call, 63); /* the caller's text will go */
    fake.calls[i].fail_in = in; fake.calls[i].code = code;
    return 1;
}

int fakedcam_fail(const char *call, int in, int32_t code) { LOCKED(int, set_failure(call, in, code)); } /* the in-th from now */

static int count_of(const char *call) {
    for (int i = 0; i < MAX_CALLS && fake.calls[i].name; i++) if (!strcmp(fake.calls[i].name, call)) return fake.calls[i].count;
    return 0;
}

int fakedcam_calls(const char *call) { LOCKED(int, count_of(call)); }

static int set_override(int p, double value) {
    if (p >= 0) { fake.overridden[p] = 1; fake.override[p] = value; }
    return p >= 0;
}

int fakedcam_override(int32_t id, double value) { LOCKED(int, set_override(find(id), value)); } /* reads so, whatever is set */

static int set_preset(int p, double value) {
    if (p >= 0) fake.props[p].value = value;
    return p >= 0;
}

int fakedcam_preset(int32_t id, double value) { LOCKED(int, set_preset(find(id), value)); } /* as another program left it */

double fakedcam_value(int32_t id) { LOCKED(double, get(find(id))); }

int fakedcam_exposed(void) { LOCKED(int, fake.exposed); }

int fakedcam_delivered(void) { LOCKED(int, fake.count); }

double fakedcam_now(void) { LOCKED(double, now()); }

void fakedcam_sleep(double seconds) { /* in virtual time */
    pthread_mutex_lock(&lock);
    fake.virtual_now += seconds;
    catch_up();
    pthread_mutex_unlock(&lock);
}

static int put(double rise) {
    if (fake.n_pulses == MAX_PULSES) return 0;
    fake.pulses[fake.n_pulses++] = rise;
    pthread_cond_broadcast(&changed);
    return 1;
}

int fakedcam_pulse(double rise) { LOCKED(int, put(rise)); } /* some time from now on and after those before */

void fakedcam_cable(double (*next)(double after)) { /* from now on the trigger input asks here instead */
    pthread_mutex_lock(&lock);
    fake.cable = next;
    fake.looked = now();
    pthread_mutex_unlock(&lock);
}

static int lose(int number) {
    if (number < 0 || number >= (int)sizeof fake.lost) return 0;
    return fake.lost[number] = 1;
}

int fakedcam_lose(int number) { LOCKED(int, lose(number)); } /* this exposure by external trigger, over the camera's life */

void fakedcam_stop(void) { pthread_mutex_lock(&lock); stop(); pthread_mutex_unlock(&lock); }

int fakedcam_live(void) { LOCKED(int, fake.session + !!fake.camera + !!fake.wait + (fake.slots > 0)); }

int fakedcam_waiters(void) { LOCKED(int, fake.waiters); }
