// The strict scan of request bodies. What it lets through must print as JSON that reads back to the
// same text; what it refuses has a fault that says where.
#include <math.h>
#include <stdint.h>
#include <stdlib.h>
#include <string.h>

#include "server/json.h"
#include "tests/fuzz/fuzz.h"

static void must_be_strict(const cJSON *item, int depth) {
    const cJSON *child, *other;
    FUZZ_MUST(depth <= JSON_MAX_DEPTH);
    FUZZ_MUST(!cJSON_IsNumber(item) || isfinite(item->valuedouble));
    cJSON_ArrayForEach(child, item) {
        if (cJSON_IsObject(item))
            for (other = child->next; other != NULL; other = other->next)
                FUZZ_MUST(strcmp(child->string, other->string) != 0);
        must_be_strict(child, depth + 1);
    }
}

int LLVMFuzzerTestOneInput(const uint8_t *data, size_t size) {
    struct faults faults = {0};
    // In a block of its own size, so that one byte too far is seen.
    char *text = malloc(size > 0 ? size : 1);
    memcpy(text, data, size);
    cJSON *json = json_parse(text, size, &faults);
    FUZZ_MUST((json == NULL) == (faults.count == 1));
    if (json != NULL) {
        must_be_strict(json, 0);
        char *once = json_print(json, false), *pretty = json_print(json, true);
        cJSON *again = json_parse(once, strlen(once), &faults);
        cJSON *indented = json_parse(pretty, strlen(pretty), &faults);
        FUZZ_MUST(again != NULL && indented != NULL);
        char *twice = json_print(again, false), *thrice = json_print(indented, false);
        FUZZ_MUST(strcmp(once, twice) == 0 && strcmp(once, thrice) == 0);
        // A merge patch on itself: what is null goes, nothing else changes, and doing it twice
        // changes nothing more.
        cJSON *merged = json_merge_patch(json, json), *more = json_merge_patch(merged, json);
        char *a = json_print(merged, false), *b = json_print(more, false);
        FUZZ_MUST(strcmp(a, b) == 0);
        free(a);
        free(b);
        cJSON_Delete(merged);
        cJSON_Delete(more);
        free(once);
        free(pretty);
        free(twice);
        free(thrice);
        cJSON_Delete(again);
        cJSON_Delete(indented);
    } else {
        FUZZ_MUST(faults.items[0].detail[0] != '\0');
    }
    cJSON_Delete(json);
    faults_free(&faults);
    free(text);
    return 0;
}
