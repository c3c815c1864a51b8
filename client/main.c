// fbar, the command-line client of fbard. The table below is the list of commands and the help.
#include <malloc.h>
#include <signal.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>

#include "client/arguments.h"
#include "client/client.h"
#include "client/interrupt.h"
#include "client/request.h"
#include "client/terminal.h"

static const struct command *const commands[] = {
    &cmd_run,    &cmd_scenes, &cmd_validate, &cmd_list,   &cmd_show,   &cmd_start,  &cmd_pause,
    &cmd_resume, &cmd_step,   &cmd_cancel,   &cmd_set,    &cmd_watch,  &cmd_record, &cmd_probes,
    &cmd_info,   &cmd_plot,   &cmd_recover,  &cmd_delete, &cmd_keygen,
};
#define N_COMMANDS (sizeof commands / sizeof *commands)

static void print_options(const struct option_spec *options) {
    for (; options && options->name; options++) {
        char left[64];
        const char letter[] = {'-', options->letter, ',', ' ', '\0'};
        snprintf(left, sizeof left, "%s--%s%s%s", options->letter ? letter : "    ", options->name,
                 options->value ? " " : "", options->value ? options->value : "");
        printf("  %-24s %s\n", left, options->doc);
    }
}

static void print_help(void) {
    puts("fbar: runs material-point simulations on an fbard daemon, and records them\n\n"
         "usage: fbar [--url URL] [--token-file FILE] [--curve-file FILE] [--json] COMMAND ...\n");
    for (size_t i = 0; i < N_COMMANDS; i++) {
        char left[64];
        snprintf(left, sizeof left, "%s %s", commands[i]->name, commands[i]->positionals);
        printf("  %-24s %s\n", left, commands[i]->summary);
    }
    puts("");
    print_options(arguments_global);
    puts("\nexamples:\n"
         "  fbar run dam-break -o dam.h5 --set fbar=false\n"
         "  fbar plot dam.h5 --field mean_stress --time 0.4 -o dam.png\n"
         "  fbar plot off.h5 on.h5 --time 0.4,1,2 -o both.png\n"
         "\n"
         "exit codes: 0 done, 1 the run failed, 2 usage or invalid scene, 3 cannot reach the "
         "daemon,\n"
         "4 I/O, 130 interrupted. `fbar COMMAND --help` tells more.");
}

static void print_command_help(const struct command *command) {
    printf("usage: fbar %s %s\n\n%s\n", command->name, command->positionals, command->summary);
    if (command->doc)
        printf("\n%s\n", command->doc);
    puts("");
    print_options(command->options);
    print_options(arguments_global);
}

static const struct command *find_command(const char *name) {
    const char *names[N_COMMANDS + 1] = {NULL};
    for (size_t i = 0; i < N_COMMANDS; i++) {
        names[i] = commands[i]->name;
        if (strcmp(commands[i]->name, name) == 0)
            return commands[i];
    }
    const char *closest = arguments_closest(name, names);
    terminal_error("%s: unknown command%s%s%s; `fbar --help` lists them", name,
                   closest ? "; did you mean " : "", closest ? closest : "", closest ? "?" : "");
    return NULL;
}

static int print_version(void) {
    puts("fbar " FBARD_VERSION);
    return CLIENT_DONE;
}

static const char *first_of(const char *a, const char *b) {
    return a ? a : b;
}

static int run_command(const struct command *command, const struct arguments *global,
                       const struct arguments *arguments) {
    char url[1024];
    const char *environment = getenv("FBAR_URL");
    const char *given = first_of(arguments_value(arguments, "url"), arguments_value(global, "url"));
    if (!given && environment && *environment)
        given = environment;
    snprintf(url, sizeof url, "%s", first_of(given, CLIENT_DEFAULT_URL));
    for (size_t n = strlen(url); n > 0 && url[n - 1] == '/'; n--)
        url[n - 1] = '\0';
    if (strncmp(url, "http://", 7) != 0 && strncmp(url, "https://", 8) != 0) {
        terminal_error("--url: must begin with http:// or https://, got \"%s\"", url);
        return CLIENT_USAGE;
    }
    struct client client = {
        .url = url,
        .url_given = given != NULL,
        .token_file = first_of(arguments_value(arguments, "token-file"),
                               arguments_value(global, "token-file")),
        .curve_file = first_of(arguments_value(arguments, "curve-file"),
                               arguments_value(global, "curve-file")),
        .json = arguments_flag(arguments, "json") || arguments_flag(global, "json"),
    };
    client.requests = request_create(client.url, client.token_file);
    if (!client.requests)
        return CLIENT_IO;
    const int code = command->run(&client, arguments);
    request_free(client.requests);
    if (fflush(stdout) != 0 || ferror(stdout)) {
        terminal_error("cannot write to standard output");
        return CLIENT_IO;
    }
    return code;
}

int main(int argc, char **argv) {
    static struct arguments global, arguments; // large
    signal(SIGPIPE, SIG_IGN);
    signal(SIGXFSZ, SIG_IGN); // a file over the limit is an error like a full disk
    // Frames come and go by the megabyte: their memory is kept instead of being mapped, and cleared
    // page by page, for each.
    mallopt(M_MMAP_THRESHOLD, 32 << 20);
    mallopt(M_TRIM_THRESHOLD, 128 << 20);
    interrupt_catch();
    const int used = arguments_parse(argc - 1, argv + 1, NULL, &global);
    if (used < 0)
        return CLIENT_USAGE;
    argc -= used + 1;
    argv += used + 1;
    if (arguments_flag(&global, "version"))
        return print_version();
    if (argc == 0 || strcmp(argv[0], "help") == 0) {
        const struct command *command = argc > 1 ? find_command(argv[1]) : NULL;
        if (argc > 1 && !command)
            return CLIENT_USAGE;
        if (command)
            print_command_help(command);
        else
            print_help();
        return argc > 0 || arguments_flag(&global, "help") ? CLIENT_DONE : CLIENT_USAGE;
    }
    if (strcmp(argv[0], "version") == 0)
        return print_version();
    const struct command *command = find_command(argv[0]);
    if (!command || arguments_parse(argc - 1, argv + 1, command, &arguments) < 0)
        return CLIENT_USAGE;
    if (arguments_flag(&arguments, "version"))
        return print_version();
    if (arguments_flag(&arguments, "help") || arguments_flag(&global, "help")) {
        print_command_help(command);
        return CLIENT_DONE;
    }
    return run_command(command, &global, &arguments);
}
