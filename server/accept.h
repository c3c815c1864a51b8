// Which of several media types a client likes best (RFC 9110, 12.4.2 and 12.5.1).
#pragma once
#include <stddef.h>

// The index of the one among `n` types ("type/subtype", lower case) that has the highest quality
// value in an Accept header, by the most specific range that takes it in. Of equal ones it is the
// one that is named more exactly, then the one whose range comes first in the header, then the
// first. 0 without a header (NULL) or with one that names none of them, -1 when each is refused
// with q=0. Ranges that are not well-formed are passed over; parameters but q are not looked at.
int accept_best(const char *header, const char *const *types, size_t n);
