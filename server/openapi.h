// OpenAPI 3.1 document of the routes table.
#pragma once
#include "server/json.h"

cJSON *openapi_document(void); // new
