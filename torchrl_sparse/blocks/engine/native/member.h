// One of the threads that share a query.

#pragma once

struct Member {
    int rank = 0, size = 1;
    void* team = nullptr;
    void (*wait)(void* team, int size) = nullptr;

    // Returns when all of them have called it.
    void barrier() const {
        if (size > 1) wait(team, size);
    }
};
