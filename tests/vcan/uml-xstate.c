/*
 * Preloaded into linux.uml: lets the 6.1 user-mode kernel run on CPUs with a large register file (Intel AMX).
 *
 * That kernel saves and restores the extended registers of its processes with a fixed buffer of 2,696 bytes (up to
 * AVX-512 and PKRU). A host CPU with AMX has about 11,000 bytes. Reading fewer bytes is allowed, but writing fewer bytes
 * fails with EFAULT, and the kernel dies before its first process runs ("ptrace set fp regs failed, errno = 14").
 * This library turns a short write into: read all bytes, replace those that the kernel knows, write all bytes. The rest
 * (the AMX tiles) keeps its value in the process. All other requests are passed to libc unchanged.
 */
#define _GNU_SOURCE
#include <dlfcn.h>
#include <elf.h>
#include <stdarg.h>
#include <string.h>
#include <sys/ptrace.h>
#include <sys/uio.h>

typedef long (*ptrace_fn)(int, pid_t, void *, void *);

static ptrace_fn next_ptrace;

/* Static, because kernel stacks there have 16 KiB. One buffer suffices, because that kernel has one CPU and no preemption. */
static _Alignas(64) unsigned char whole[65536];

/* Looked up at start, because the dynamic linker needs more stack than a kernel thread has. */
__attribute__((constructor)) static void find_ptrace(void)
{
	next_ptrace = (ptrace_fn)dlsym(RTLD_NEXT, "ptrace");
}

static long set_xstate(pid_t pid, const struct iovec *part)
{
	struct iovec full = { whole, sizeof whole };

	if (next_ptrace(PTRACE_GETREGSET, pid, (void *)NT_X86_XSTATE, &full) < 0)
		return -1;
	memcpy(whole, part->iov_base, part->iov_len < full.iov_len ? part->iov_len : full.iov_len);
	return next_ptrace(PTRACE_SETREGSET, pid, (void *)NT_X86_XSTATE, &full);
}

long ptrace(enum __ptrace_request request, ...)
{
	va_list rest;
	va_start(rest, request);
	pid_t pid = va_arg(rest, pid_t);
	void *addr = va_arg(rest, void *);
	void *data = va_arg(rest, void *);
	va_end(rest);

	if (request == PTRACE_SETREGSET && addr == (void *)NT_X86_XSTATE)
		return set_xstate(pid, data);
	return next_ptrace(request, pid, addr, data);
}
