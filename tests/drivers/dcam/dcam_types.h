/* Structures and error numbers of the DCAM-API v4, typed by hand from the interface facts, never derived from the Python
 * module, so that the two check each other. */
#include <stddef.h>
#include <stdint.h>
#include <stdio.h>

typedef struct { int32_t size, iDeviceCount, reserved, initoptionbytes; const int32_t *initoption; const void *guid; } DCAMAPI_INIT;
typedef struct { int32_t size, index; void *hdcam; } DCAMDEV_OPEN;
typedef struct { int32_t size, domain, capflag, kind; } DCAMDEV_CAPABILITY;
typedef struct { int32_t size, iString; char *text; int32_t textbytes; } DCAMDEV_STRING;
typedef struct {
    int32_t cbSize, iProp, option, iReserved1, attribute, iGroup, iUnit, attribute2;
    double valuemin, valuemax, valuestep, valuedefault;
    int32_t nMaxChannel, iReserved3, nMaxView, iProp_NumberOfElement, iProp_ArrayBase, iPropStep_Element;
} DCAMPROP_ATTR;
typedef struct { uint32_t sec; int32_t microsec; } DCAM_TIMESTAMP;
typedef struct { int32_t size, iKind, nNewestFrameIndex, nFrameCount; } DCAMCAP_TRANSFERINFO;
typedef struct {
    int32_t size, iKind, option, iFrame;
    void *buf;
    int32_t rowbytes, type, width, height, left, top;
    DCAM_TIMESTAMP timestamp;
    int32_t framestamp, camerastamp;
} DCAMBUF_FRAME;
typedef struct { int32_t size, supportevent; void *hwait, *hdcam; } DCAMWAIT_OPEN;
typedef struct { int32_t size, eventhappened, eventmask, timeout; } DCAMWAIT_START;

#define ERR(code) ((int32_t)(code))
#define SUCCESS 1
#define NONE 0 /* nothing to do: not a failure */
#define BUSY ERR(0x80000101u)
#define ABORT ERR(0x80000102u)
#define NOTREADY ERR(0x80000103u)
#define NOTSTABLE ERR(0x80000104u)
#define TIMEOUT ERR(0x80000106u)
#define NOMEMORY ERR(0x80000203u)
#define NOCAMERA ERR(0x80000206u)
#define LOSTFRAME ERR(0x80000301u)
#define INVALIDCAMERA ERR(0x80000806u)
#define INVALIDHANDLE ERR(0x80000807u)
#define INVALIDPARAM ERR(0x80000808u)
#define INVALIDVALUE ERR(0x80000821u)
#define OUTOFRANGE ERR(0x80000822u)
#define NOTWRITABLE ERR(0x80000823u)
#define INVALIDSUBARRAY ERR(0x8000082Bu)
#define INVALIDFRAMEINDEX ERR(0x80000833u)
#define NOTSUPPORT ERR(0x80000F03u)
#define UNLOADED ERR(0x80000F04u)
#define NOCONNECTION ERR(0x80000F07u)
#define INVALIDWAITHANDLE ERR(0x84002001u)

#define F(type, field) n += snprintf(out + n, (size_t)(size - n), " %zu", offsetof(type, field))
#define T(type) n += snprintf(out + n, (size_t)(size - n), "\n%s %zu", #type, sizeof(type))
int fakedcam_layout(char *out, int size) {
    int n = 0;
    T(DCAMAPI_INIT); F(DCAMAPI_INIT, size); F(DCAMAPI_INIT, iDeviceCount); F(DCAMAPI_INIT, reserved);
    F(DCAMAPI_INIT, initoptionbytes); F(DCAMAPI_INIT, initoption); F(DCAMAPI_INIT, guid);
    T(DCAMDEV_OPEN); F(DCAMDEV_OPEN, size); F(DCAMDEV_OPEN, index); F(DCAMDEV_OPEN, hdcam);
    T(DCAMDEV_CAPABILITY); F(DCAMDEV_CAPABILITY, size); F(DCAMDEV_CAPABILITY, domain); F(DCAMDEV_CAPABILITY, capflag); F(DCAMDEV_CAPABILITY, kind);
    T(DCAMDEV_STRING); F(DCAMDEV_STRING, size); F(DCAMDEV_STRING, iString); F(DCAMDEV_STRING, text); F(DCAMDEV_STRING, textbytes);
    T(DCAMPROP_ATTR); F(DCAMPROP_ATTR, cbSize); F(DCAMPROP_ATTR, iProp); F(DCAMPROP_ATTR, option); F(DCAMPROP_ATTR, iReserved1);
    F(DCAMPROP_ATTR, attribute); F(DCAMPROP_ATTR, iGroup); F(DCAMPROP_ATTR, iUnit); F(DCAMPROP_ATTR, attribute2);
    F(DCAMPROP_ATTR, valuemin); F(DCAMPROP_ATTR, valuemax); F(DCAMPROP_ATTR, valuestep); F(DCAMPROP_ATTR, valuedefault);
    F(DCAMPROP_ATTR, nMaxChannel); F(DCAMPROP_ATTR, iReserved3); F(DCAMPROP_ATTR, nMaxView);
    F(DCAMPROP_ATTR, iProp_NumberOfElement); F(DCAMPROP_ATTR, iProp_ArrayBase); F(DCAMPROP_ATTR, iPropStep_Element);
    T(DCAM_TIMESTAMP); F(DCAM_TIMESTAMP, sec); F(DCAM_TIMESTAMP, microsec);
    T(DCAMCAP_TRANSFERINFO); F(DCAMCAP_TRANSFERINFO, size); F(DCAMCAP_TRANSFERINFO, iKind);
    F(DCAMCAP_TRANSFERINFO, nNewestFrameIndex); F(DCAMCAP_TRANSFERINFO, nFrameCount);
    T(DCAMBUF_FRAME); F(DCAMBUF_FRAME, size); F(DCAMBUF_FRAME, iKind); F(DCAMBUF_FRAME, option); F(DCAMBUF_FRAME, iFrame);
    F(DCAMBUF_FRAME, buf); F(DCAMBUF_FRAME, rowbytes); F(DCAMBUF_FRAME, type); F(DCAMBUF_FRAME, width); F(DCAMBUF_FRAME, height);
    F(DCAMBUF_FRAME, left); F(DCAMBUF_FRAME, top); F(DCAMBUF_FRAME, timestamp); F(DCAMBUF_FRAME, framestamp); F(DCAMBUF_FRAME, camerastamp);
    T(DCAMWAIT_OPEN); F(DCAMWAIT_OPEN, size); F(DCAMWAIT_OPEN, supportevent); F(DCAMWAIT_OPEN, hwait); F(DCAMWAIT_OPEN, hdcam);
    T(DCAMWAIT_START); F(DCAMWAIT_START, size); F(DCAMWAIT_START, eventhappened); F(DCAMWAIT_START, eventmask); F(DCAMWAIT_START, timeout);
    return n;
}
