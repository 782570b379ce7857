//! Reads the state of our sockets and threads from `/proc`.

use std::collections::{HashMap, HashSet};
use std::fs;
use std::io;
use std::net::UdpSocket;
use std::os::fd::OwnedFd;

use rustix::net::sockopt;
use rustix::process::{PidfdFlags, PidfdGetfdFlags, getpid, pidfd_getfd, pidfd_open};

/// Prefix of the names of all RustDDS threads.
const LIBRARY: &str = "RustDDS ";
/// The thread that reads the sockets; the kernel keeps 15 bytes of `RustDDS Participant 0 event
/// loop`.
const READS: &str = "RustDDS Partici";

/// The port at which all participants of a domain receive samples by multicast.
///
/// RTPS, "Default Port Numbers": multicast for discovery and for samples, and from the tenth on,
/// two ports for each participant.
pub(super) fn port_of_samples(domain: u16) -> u16 {
    7401 + 250 * domain
}

/// The receive sockets of a participant.
#[derive(Debug, Default)]
pub(super) struct Sockets {
    /// Descriptors, by inode.
    open: HashMap<u64, i32>,
    /// Datagrams that sockets of this network namespace had dropped for lack of room before these
    /// were opened.
    full_before: Option<u64>,
}

/// The state of the receive queues.
#[derive(Copy, Clone, Debug, Default, PartialEq, Eq)]
pub(super) struct Queues {
    /// Bytes that wait to be read.
    pub(super) waiting: u64,
    /// Number of datagrams that were dropped for lack of room.
    pub(super) drops: u64,
    /// Number of datagrams that the filter dropped.
    pub(super) filtered: u64,
}

impl Sockets {
    /// The sockets of this process at the ports of a participant.
    pub(super) fn of(domain: u16, participant: u16) -> Self {
        let samples = u32::from(port_of_samples(domain));
        let own = samples + 9 + 2 * u32::from(participant);
        let ports = [samples - 1, samples, own, own + 1];
        let mut mine = inodes();
        let rows = rows().into_iter().filter(|row| ports.contains(&row.port));
        let open = rows.filter_map(|row| mine.remove_entry(&row.inode)).collect();
        Self { open, full_before: full() }
    }

    pub(super) fn queues(&self) -> Queues {
        let (mut waiting, mut drops) = (0_u64, 0_u64);
        for row in rows().iter().filter(|row| self.open.contains_key(&row.inode)) {
            waiting = waiting.saturating_add(row.waiting);
            drops = drops.saturating_add(row.drops);
        }
        let full = self
            .full_before
            .zip(full())
            .map_or(u64::MAX, |(before, now)| now.saturating_sub(before))
            .min(drops);
        Queues { waiting, drops: full, filtered: drops - full }
    }

    /// Duplicates the sockets, to set options for which RustDDS has no interface.
    pub(super) fn duplicates(&self) -> io::Result<Vec<OwnedFd>> {
        let this = pidfd_open(getpid(), PidfdFlags::empty())?;
        let duplicate =
            |descriptor: &i32| Ok(pidfd_getfd(&this, *descriptor, PidfdGetfdFlags::empty())?);
        self.open.values().map(duplicate).collect()
    }
}

/// Number of datagrams that sockets of this network namespace dropped for lack of room. For one
/// socket the kernel has one number only, for a full buffer and for its filter together.
fn full() -> Option<u64> {
    let table = fs::read_to_string("/proc/self/net/snmp").ok()?;
    let mut lines = table.lines().filter_map(|line| line.strip_prefix("Udp:"));
    let (names, numbers) = (lines.next()?, lines.next()?);
    let mut columns = names.split_ascii_whitespace().zip(numbers.split_ascii_whitespace());
    columns.find(|(name, _)| *name == "RcvbufErrors")?.1.parse().ok()
}

struct Row {
    port: u32,
    waiting: u64,
    inode: u64,
    drops: u64,
}

/// The UDP sockets of our network namespace. RustDDS listens with IPv4 only.
fn rows() -> Vec<Row> {
    let table = fs::read_to_string("/proc/self/net/udp").unwrap_or_default();
    table.lines().skip(1).filter_map(row).collect()
}

fn row(line: &str) -> Option<Row> {
    let fields: Vec<&str> = line.split_ascii_whitespace().collect();
    let hex = |field: &str, after: char| u64::from_str_radix(field.rsplit_once(after)?.1, 16).ok();
    Some(Row {
        port: u32::try_from(hex(fields.get(1)?, ':')?).ok()?,
        waiting: hex(fields.get(4)?, ':')?,
        inode: fields.get(9)?.parse().ok()?,
        drops: fields.get(12)?.parse().ok()?,
    })
}

/// The open sockets of this process: descriptors, by inode.
fn inodes() -> HashMap<u64, i32> {
    let Ok(open) = fs::read_dir("/proc/self/fd") else { return HashMap::new() };
    let inode = |entry: fs::DirEntry| {
        let target = fs::read_link(entry.path()).ok()?;
        let inode = target.to_str()?.strip_prefix("socket:[")?.strip_suffix(']')?.parse().ok()?;
        Some((inode, entry.file_name().to_str()?.parse().ok()?))
    };
    open.flatten().filter_map(inode).collect()
}

/// Returns the receive buffer in bytes that the kernel grants a socket that requests `asked`.
///
/// All sockets of a process get the same for the same request, so a test socket stands for the
/// participant's. Linux reports twice the granted size.
pub(super) fn granted(asked: usize) -> Option<usize> {
    let socket = UdpSocket::bind(("127.0.0.1", 0)).ok()?;
    sockopt::set_socket_recv_buffer_size(&socket, asked).ok()?;
    sockopt::socket_recv_buffer_size(&socket).ok().map(|doubled| doubled / 2)
}

/// The threads of RustDDS in this process.
pub(super) fn library_threads() -> HashSet<u32> {
    let Ok(tasks) = fs::read_dir("/proc/self/task") else { return HashSet::new() };
    let id = |entry: fs::DirEntry| entry.file_name().to_str()?.parse().ok();
    tasks.flatten().filter_map(id).filter(|id| is_library(*id)).collect()
}

/// Returns one of `threads` that has ended, if any.
pub(super) fn gone(threads: &HashSet<u32>) -> Option<u32> {
    threads.iter().copied().find(|id| !is_library(*id))
}

/// CPU time used by those of `threads` that read sockets, in ticks of the kernel, mostly of 10 ms.
pub(super) fn busy(threads: &HashSet<u32>) -> u64 {
    let used = |thread: &u32| {
        let stat = fs::read_to_string(format!("/proc/self/task/{thread}/stat")).ok()?;
        ticks(&stat, READS)
    };
    threads.iter().filter_map(used).sum()
}

/// Parses user and system time from a line of `stat`, if the thread has this name.
fn ticks(stat: &str, name: &str) -> Option<u64> {
    // The name may contain anything, but nothing after it contains a parenthesis.
    let (front, rest) = stat.rsplit_once(')')?;
    let mut fields = rest.split_ascii_whitespace().skip(11).map(str::parse::<u64>);
    let used = fields.next()?.ok()? + fields.next()?.ok()?;
    (front.split_once('(')?.1 == name).then_some(used)
}

fn is_library(thread: u32) -> bool {
    fs::read_to_string(format!("/proc/self/task/{thread}/comm"))
        .is_ok_and(|name| name.starts_with(LIBRARY))
}

#[cfg(test)]
mod tests {
    use std::sync::mpsc;
    use std::thread;

    use socket2::{SockFilter, SockRef};

    use super::*;

    fn sockets_of(socket: &UdpSocket) -> Sockets {
        let port = u32::from(socket.local_addr().unwrap().port());
        let mut mine = inodes();
        let open = rows()
            .into_iter()
            .filter(|row| row.port == port)
            .find_map(|row| mine.remove_entry(&row.inode));
        Sockets { open: HashMap::from([open.unwrap()]), full_before: full() }
    }

    #[test]
    fn a_line_of_the_table_is_parsed() {
        let line = " 3431: 00000000:1CE8 00000000:0000 07 00000000:00001A00 00:00000000 00000000  \
                    1000        0 98765 2 0000000000000000 42";
        let row = row(line).unwrap();
        assert_eq!((row.port, row.waiting, row.inode, row.drops), (7400, 0x1a00, 98765, 42));
        assert!(super::row("sl local_address").is_none());
        assert!(super::row("").is_none());
    }

    #[test]
    fn the_cpu_time_of_the_reading_thread_is_parsed() {
        let line = |name: &str| {
            format!("77 ({name}) S 1 77 77 0 -1 64 5 0 0 0 130 7 0 0 20 0 9 0 8315 1 2 3")
        };
        assert_eq!(ticks(&line("RustDDS Partici"), READS), Some(137));
        assert_eq!(ticks(&line("RustDDS discove"), READS), None);
        assert_eq!(ticks(&line("a) S (b"), "a) S (b"), Some(137));
        assert_eq!(ticks("77 (x) S 1", "x"), None);
        let own = fs::read_to_string("/proc/thread-self/stat").unwrap();
        let name = fs::read_to_string("/proc/thread-self/comm").unwrap();
        assert!(ticks(&own, name.trim_end_matches('\n')).is_some(), "{own}");
    }

    #[test]
    fn waiting_bytes_and_drops_of_a_socket_are_counted() {
        let socket = UdpSocket::bind(("127.0.0.1", 0)).unwrap();
        sockopt::set_socket_recv_buffer_size(&socket, 1).unwrap();
        let sockets = sockets_of(&socket);
        assert_eq!(sockets.queues(), Queues::default());
        for _ in 0..100 {
            socket.send_to(&[0; 1000], socket.local_addr().unwrap()).unwrap();
        }
        let queues = sockets.queues();
        assert!(queues.waiting > 0 && queues.drops > 0, "{queues:?}");
        socket.set_nonblocking(true).unwrap();
        let came = (0..100).take_while(|_| socket.recv(&mut [0; 1000]).is_ok()).count() as u64;
        assert_eq!((queues.drops, queues.filtered), (100 - came, 0));
    }

    #[test]
    fn drops_of_a_filter_on_a_duplicate_do_not_count_as_a_full_buffer() {
        loop {
            let socket = UdpSocket::bind(("127.0.0.1", 0)).unwrap();
            let sockets = sockets_of(&socket);
            let [duplicate] = sockets.duplicates().unwrap().try_into().unwrap();
            // RET 0: nothing passes.
            SockRef::from(&duplicate).attach_filter(&[SockFilter::new(6, 0, 0, 0)]).unwrap();
            for _ in 0..7 {
                socket.send_to(&[0; 1000], socket.local_addr().unwrap()).unwrap();
            }
            let queues = sockets.queues();
            // If buffers of other programs were full meanwhile, the parts cannot be separated: try
            // again.
            if full() == sockets.full_before {
                assert_eq!(queues, Queues { waiting: 0, drops: 0, filtered: 7 });
                return;
            }
            assert_eq!((queues.waiting, queues.drops + queues.filtered), (0, 7));
        }
    }

    #[test]
    fn a_small_buffer_is_granted_and_a_huge_one_is_not() {
        assert_eq!(granted(64 << 10), Some(64 << 10));
        assert!(granted(1 << 30).unwrap() < 1 << 30);
    }

    #[test]
    fn a_thread_of_the_library_is_found_by_its_name_and_missed_when_it_ends() {
        let (end, ended) = mpsc::channel::<()>();
        let (begun, begins) = mpsc::channel();
        let name = format!("{LIBRARY}test");
        let body = move || {
            begun.send(rustix::thread::gettid().as_raw_nonzero().get() as u32).unwrap();
            let _ = ended.recv();
        };
        let thread = thread::Builder::new().name(name).spawn(body).unwrap();
        let id = begins.recv().unwrap();
        assert!(library_threads().contains(&id));
        assert_eq!(gone(&HashSet::from([id])), None);
        drop(end);
        thread.join().unwrap();
        // The kernel removes the thread a moment after it was joined.
        while gone(&HashSet::from([id])).is_none() {
            thread::yield_now();
        }
    }
}
