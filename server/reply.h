// Bodies of replies: JSON, text, and problems (RFC 9457) with all faults of a request.
#pragma once
#include "server/http.h"
#include "server/json.h"

// `text` comes from malloc and is the reply's from then on; NULL makes it a 500.
void reply_text(struct http_reply *reply, int status, const char *type, char *text);
void reply_json(struct http_reply *reply, int status, cJSON *json); // takes the JSON
void reply_problem(struct http_reply *reply, int status, const struct faults *faults,
                   const char *format, ...) __attribute__((format(printf, 4, 5)));
// A problem whose detail is the first fault, so that a client that shows only that is useful.
void reply_faults(struct http_reply *reply, int status, const struct faults *faults);
// A number with all its bits; null when it is not finite.
void reply_add(cJSON *object, const char *key, double value);
