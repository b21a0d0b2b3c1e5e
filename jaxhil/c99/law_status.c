/* What a law says of its own command: its status after each tick, counted over a contact. The contact is too
 * short or unsure, by the more frequent, where the law was either on more than two fifths of the ticks on which it
 * acted; else saturated, where its correction was at its limit on more than half of them; else identified.
 */
#include <stdbool.h>
#include <stdint.h>

#include "law_status_table.c"

/* == Declarations == */

/* What the law said of a contact: the contact's number, 0 before the first; on how many ticks the law acted, and
 * on how many of them it was unsure, saturated, or found the contact too short; the status that counts. */
typedef struct {
    int64_t number, ticks, unsure, saturated, too_short;
    int status;
} jaxhil_contact_record;

/* == Definitions == */

static const double jaxhil_doubtful = 0.4; /* of the ticks on which the law acts */
static const double jaxhil_saturating = 0.5;

static jaxhil_contact_record jaxhil_contact_record_begin(int64_t number, int status) {
    const jaxhil_contact_record record = {number, 0, 0, 0, 0, status};
    return record;
}

/* One tick's status. */
static void jaxhil_contact_record_take(jaxhil_contact_record *record, int status) {
    record->ticks += status != JAXHIL_UNSTATED && status != JAXHIL_OUT_OF_CONTACT;
    record->unsure += status == JAXHIL_UNSURE;
    record->saturated += status == JAXHIL_SATURATED;
    record->too_short += status == JAXHIL_TOO_SHORT;
}

/* The contact is over: the status that counts. Whether the law had too little time or room to correct it. */
static bool jaxhil_contact_record_end(jaxhil_contact_record *record) {
    record->status = JAXHIL_IDENTIFIED;
    if (record->ticks == 0) {
        record->status = JAXHIL_OUT_OF_CONTACT;
    } else if ((double)(record->unsure + record->too_short) > jaxhil_doubtful * (double)record->ticks) {
        record->status = record->too_short > record->unsure ? JAXHIL_TOO_SHORT : JAXHIL_UNSURE;
    } else if ((double)record->saturated > jaxhil_saturating * (double)record->ticks) {
        record->status = JAXHIL_SATURATED;
    }
    return record->status != JAXHIL_OUT_OF_CONTACT && record->status != JAXHIL_IDENTIFIED;
}
