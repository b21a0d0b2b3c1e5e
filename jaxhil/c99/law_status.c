/* What a law says of its own command: its status after each tick, counted over a contact. The contact is not
 * reached where no force was measured; unsure where the law did not act; else unsure, too short or
 * noisy, by the most frequent, where the law was any of them on more than two fifths of the ticks on which it acted;
 * else unexplained or saturated, where it was so on the last of them; else identified.
 */
#include <stdbool.h>
#include <stdint.h>

#include "law_status_table.c"

/* == Declarations == */

/* What the law said of a contact: the contact's number, 0 before the first; on how many ticks the law acted, and
 * on how many of them it was unsure, saturated, or found the contact too short or noisy; its status on
 * the last of them, and the status that counts. */
typedef struct {
    int64_t number, ticks, unsure, saturated, too_short, noisy;
    int last, status;
} jaxhil_contact_record;

/* == Definitions == */

static const double jaxhil_doubtful = 0.4; /* of the ticks on which the law acts */

static jaxhil_contact_record jaxhil_contact_record_begin(int64_t number, int status) {
    const jaxhil_contact_record record = {number, 0, 0, 0, 0, 0, JAXHIL_OUT_OF_CONTACT, status};
    return record;
}

/* One tick's status. */
static void jaxhil_contact_record_take(jaxhil_contact_record *record, int status) {
    if (status != JAXHIL_UNSTATED && status != JAXHIL_OUT_OF_CONTACT) {
        record->ticks++;
        record->last = status;
    }
    record->unsure += status == JAXHIL_UNSURE;
    record->saturated += status == JAXHIL_SATURATED;
    record->too_short += status == JAXHIL_TOO_SHORT;
    record->noisy += status == JAXHIL_NOISY;
}

/* The contact is over, a force was measured in it or not: the status that counts. Whether the law is in doubt of
 * it. */
static bool jaxhil_contact_record_end(jaxhil_contact_record *record, bool measured) {
    const int64_t doubts[] = {record->unsure, record->too_short, record->noisy};
    const int statuses[] = {JAXHIL_UNSURE, JAXHIL_TOO_SHORT, JAXHIL_NOISY};
    int64_t all = 0;
    int most = 0;
    for (int i = 0; i < 3; i++) {
        all += doubts[i];
        most = doubts[i] > doubts[most] ? i : most;
    }
    record->status = JAXHIL_IDENTIFIED;
    if (!measured) {
        record->status = JAXHIL_NOT_REACHED;
    } else if (record->ticks == 0) {
        record->status = JAXHIL_UNSURE;
    } else if ((double)all > jaxhil_doubtful * (double)record->ticks) {
        record->status = statuses[most];
    } else if (record->last == JAXHIL_UNEXPLAINED || record->last == JAXHIL_SATURATED) {
        record->status = record->last;
    }
    return record->status != JAXHIL_IDENTIFIED;
}
