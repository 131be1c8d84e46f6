// A few threads of this process that work on one query together.
//
// There is one team, whoever asks for it: a caller that finds it busy works alone, so that engines and threads beside each
// other never have more workers at once than one of them would. Workers spin for as long as a wait within a query takes and
// then sleep: between the queries of a control loop they cost nothing. A forked child starts without workers and makes its
// own; nothing outlives the process, and nothing has to be ended with it.

#pragma once

#include <pthread.h>
#include <signal.h>

#include <atomic>
#include <chrono>
#include <condition_variable>
#include <cstdint>
#include <mutex>
#include <new>
#include <system_error>
#include <thread>

#include "member.h"
#include "structs.h"

namespace {

constexpr std::chrono::microseconds SPIN{50};  // longer than any block of a published network takes

inline void cpu_relax() {
#if defined(__x86_64__)
    __builtin_ia32_pause();
#elif defined(__aarch64__)
    asm volatile("yield");
#endif
}

// A number that only grows, and that threads wait for. On cache lines of its own.
class alignas(64) Counter {
  public:
    uint32_t value() const { return value_.load(std::memory_order_acquire); }

    void advance() {
        value_.fetch_add(1);  // before `sleepers_` is read: either a sleeper sees the new value, or it is woken
        if (!sleepers_.load()) return;
        { const std::lock_guard<std::mutex> lock(mutex_); }
        woken_.notify_all();
    }

    // Returns when the value is another than `seen`.
    void wait(uint32_t seen) {
        if (changes(seen)) return;  // before the clock is asked: most waits are shorter
        const auto end = std::chrono::steady_clock::now() + SPIN;
        do
            if (changes(seen)) return;
        while (std::chrono::steady_clock::now() < end);
        std::unique_lock<std::mutex> lock(mutex_);
        sleepers_++;
        woken_.wait(lock, [&] { return value_.load() != seen; });
        sleepers_--;
    }

  private:
    // Whether the value is another than `seen`, or becomes one within a microsecond or so.
    bool changes(uint32_t seen) const {
        for (int i = 0; i < 64; i++) {
            if (value() != seen) return true;
            cpu_relax();
        }
        return false;
    }

    std::atomic<uint32_t> value_{0}, sleepers_{0};
    std::mutex mutex_;
    std::condition_variable woken_;
};

class Team {
  public:
    using Job = void (*)(const Member& who, void* data);

    // Runs `job` in up to `threads` threads, the caller's being number 0; in that one alone where the team is busy.
    static void run(int threads, Job job, void* data) {
        if (threads > 1) {
            Team& team = instance();
            const std::unique_lock<std::mutex> turn(team.turn_, std::try_to_lock);
            if (turn) return team.lead(threads < MAX_THREADS ? threads : MAX_THREADS, job, data);
        }
        job(Member{}, data);
    }

  private:
    // Never deleted: threads that wait for it may outlive everything else in the process.
    static Team& instance() {
        static const int once = pthread_atfork(nullptr, nullptr, [] { current() = nullptr; });  // threads do not come along
        (void)once;
        Team* found = current();
        if (found) return *found;
        Team* const made = new Team;
        if (current().compare_exchange_strong(found, made)) return *made;
        delete made;
        return *found;
    }

    static std::atomic<Team*>& current() {
        static std::atomic<Team*> team{nullptr};
        return team;
    }

    void lead(int threads, Job job, void* data) {
        const int size = grow(threads);
        job_ = job, data_ = data, size_ = size;
        for (int rank = 1; rank < size; rank++) orders_[rank].advance();
        const Member who{0, size, this, wait};
        job(who, data);
        if (size > 1) barrier(size);
    }

    void work(int rank) {
        for (uint32_t seen = 0;; seen++) {
            orders_[rank].wait(seen);
            const int size = size_;
            job_(Member{rank, size, this, wait}, data_);
            barrier(size);
        }
    }

    // Returns when `size` threads have called it.
    void barrier(int size) {
        const uint32_t seen = generation_.value();
        if (arrived_.fetch_add(1) == size - 1) {
            arrived_.store(0);
            generation_.advance();
        } else {
            generation_.wait(seen);
        }
    }

    static void wait(void* team, int size) { static_cast<Team*>(team)->barrier(size); }

    // Starts workers until there are `threads` threads with the caller's; returns how many there are, if the system has no more.
    int grow(int threads) {
        if (count_ >= threads) return threads;
        sigset_t all, before;  // signals are for the threads that were there before
        sigfillset(&all);
        pthread_sigmask(SIG_SETMASK, &all, &before);
        try {
            for (; count_ < threads; count_++) std::thread(&Team::work, this, count_).detach();
        } catch (const std::system_error&) {
        }
        pthread_sigmask(SIG_SETMASK, &before, nullptr);
        return count_;
    }

    std::mutex turn_;
    int count_ = 1;  // threads, the caller's being one
    Job job_ = nullptr;
    void* data_ = nullptr;
    int size_ = 1;
    alignas(64) std::atomic<int> arrived_{0};
    Counter generation_, orders_[MAX_THREADS];
};

}  // namespace
