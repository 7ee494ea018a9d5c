// Counts what a kernel's own text reads and writes of tensors, where it runs on the processor (cuda_on_host.h).
//
// The compiler calls these functions before every access to memory, as it does for its thread sanitizer
// (-fsanitize=thread), whose own library is not linked: the kernel is the text as it stands. Accesses outside of the
// tensors (a thread's own variables, shared memory) do not count. Of reads and of writes, three sums of bytes:
//
//   once     each byte of a tensor that a launch touches, once: what passes where caches forget nothing
//   blocks   sectors of 32 bytes that a block touches, each once, over all blocks: where each block has a cache of its own
//   lanes    sectors that the lanes of a warp touch at once, over all their accesses: where there is no cache at all
#include <cstdint>
#include <map>
#include <set>
#include <tuple>
#include <vector>

extern "C" unsigned long long host_block();   // the block that runs
extern "C" unsigned long long host_thread();  // and its thread

namespace {

constexpr uintptr_t kSector = 32;
constexpr unsigned long long kWarp = 32;

// One of reads and writes of one tensor.
struct Direction {
  std::vector<bool> touched;                // bytes, in the launch
  std::set<uintptr_t> sectors;              // of the block
  unsigned long long once, blocks, lanes;
};

struct Watched {
  uintptr_t begin, end;
  Direction read, written;
};

// What the lanes of a warp touch at once: what of, where in the code, which warp, for the how manieth time there.
using Access = std::tuple<Direction*, const void*, unsigned long long, unsigned long long>;

std::vector<Watched> tensors;
std::map<std::tuple<Direction*, const void*, unsigned long long>, unsigned long long> times;  // of a thread
std::map<Access, std::set<uintptr_t>> of_warps;
unsigned long long block = ~0ull;

void end_block() {
  for (const auto& [access, sectors] : of_warps) std::get<Direction*>(access)->lanes += kSector * sectors.size();
  of_warps.clear(), times.clear();
  for (Watched& each : tensors)
    for (Direction* direction : {&each.read, &each.written}) {
      direction->blocks += kSector * direction->sectors.size();
      direction->sectors.clear();
    }
}

void touch(const void* from, const void* code, uintptr_t size, bool writes) {
  const uintptr_t address = reinterpret_cast<uintptr_t>(from);
  for (Watched& each : tensors) {
    if (address < each.begin || address >= each.end) continue;
    if (host_block() != block) end_block(), block = host_block();
    Direction& direction = writes ? each.written : each.read;
    const unsigned long long thread = host_thread(), nth = times[{&direction, code, thread}]++;
    std::set<uintptr_t>& at_once = of_warps[{&direction, code, thread / kWarp, nth}];
    for (uintptr_t byte = address; byte < address + size; ++byte) {
      direction.once += !direction.touched[byte - each.begin];
      direction.touched[byte - each.begin] = true;
      direction.sectors.insert(byte / kSector);
      at_once.insert(byte / kSector);
    }
    return;
  }
}

}  // namespace

// Until `traffic_end`, accesses to these tensors count.
extern "C" void traffic_begin(int count, const unsigned long long* begins, const unsigned long long* bytes) {
  for (int i = 0; i < count; ++i) {
    const std::vector<bool> untouched(bytes[i]);
    tensors.push_back({begins[i], begins[i] + bytes[i], {untouched, {}, 0, 0, 0}, {untouched, {}, 0, 0, 0}});
  }
}

// Six numbers a tensor: once, blocks, lanes read, and the same written.
extern "C" void traffic_end(unsigned long long* found) {
  end_block();
  block = ~0ull;
  for (const Watched& each : tensors)
    for (const Direction* direction : {&each.read, &each.written}) {
      *found++ = direction->once, *found++ = direction->blocks, *found++ = direction->lanes;
    }
  tensors.clear();
}

#define ACCESS(bytes)                                                                                             \
  extern "C" void __tsan_read##bytes(void* at) { touch(at, __builtin_return_address(0), bytes, false); }           \
  extern "C" void __tsan_write##bytes(void* at) { touch(at, __builtin_return_address(0), bytes, true); }           \
  extern "C" void __tsan_unaligned_read##bytes(void* at) { touch(at, __builtin_return_address(0), bytes, false); } \
  extern "C" void __tsan_unaligned_write##bytes(void* at) { touch(at, __builtin_return_address(0), bytes, true); }
ACCESS(1)
ACCESS(2)
ACCESS(4)
ACCESS(8)
ACCESS(16)
extern "C" void __tsan_read_range(void* at, unsigned long size) {
  touch(at, __builtin_return_address(0), size, false);
}
extern "C" void __tsan_write_range(void* at, unsigned long size) {
  touch(at, __builtin_return_address(0), size, true);
}
extern "C" void __tsan_init() {}
extern "C" void __tsan_func_entry(void*) {}
extern "C" void __tsan_func_exit() {}
