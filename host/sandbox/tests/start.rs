//! Tests the effects of code that runs before the lambda. Each test sandboxes a process of its own.
#![allow(unsafe_code)]

use std::fs::{self, File};
use std::hint::black_box;
use std::io::{Error, ErrorKind, Write};
use std::net::{TcpStream, UdpSocket};
use std::os::unix::net::UnixStream;
use std::process::Command;
use std::sync::mpsc;
use std::thread;

use gleaner_protocol::{Holds, Layer};
use gleaner_sandbox::ingress::{self, NewSockets};
use gleaner_sandbox::{
    JailError, Paths, base_filter, inference, memory, recorder, sandbox_filter, sockets,
};
use rustix::fs::{FallocateFlags, MemfdFlags, fallocate, memfd_create};
use rustix::io::Errno;
use rustix::net::{AddressFamily, SocketAddrUnix, SocketType, bind, connect, listen, socket};
use rustix::process::{Resource, Rlimit, getpid, getppid, getrlimit, test_kill_process};

/// Set in the process that a test starts.
const CHILD: &str = "GLEANER_JAIL_TEST";

/// Runs `test`, which has the name `name`, in a process of its own.
#[track_caller]
fn in_own_process(name: &str, test: fn()) {
    if std::env::var_os(CHILD).is_some() {
        return test();
    }
    let mut again = Command::new(std::env::current_exe().unwrap());
    let output = again.args(["--exact", name, "--nocapture"]).env(CHILD, "1").output().unwrap();
    let output_text =
        String::from_utf8_lossy(&output.stdout) + String::from_utf8_lossy(&output.stderr);
    assert!(output.status.success() && output_text.contains("1 passed"), "{output_text}");
}

#[test]
fn all_threads_are_sandboxed() {
    in_own_process("all_threads_are_sandboxed", || {
        base_filter::apply();
        let mut layers = vec![sandbox_filter::apply_before_interpreter(true)];
        layers.extend(sandbox_filter::apply(true).unwrap());
        assert!(layers.iter().all(|layer| layer.holds == Holds::Yes), "{layers:?}");
    });
}

#[test]
fn a_thread_with_its_own_filter_is_an_error() {
    in_own_process("a_thread_with_its_own_filter_is_an_error", || {
        base_filter::apply();
        let (ready, is_ready) = mpsc::channel();
        let (_end, ended) = mpsc::channel::<()>();
        thread::spawn(move || {
            assert_eq!(sandbox_filter::apply_before_interpreter(false).holds, Holds::Yes);
            ready.send(()).unwrap();
            let _ = ended.recv();
        });
        is_ready.recv().unwrap();
        let error = sandbox_filter::apply(true).unwrap_err();
        assert!(matches!(error, JailError::ExistingThread(_)), "{}", error.chain());
    });
}

#[test]
fn a_starting_interpreter_sends_no_signals_and_has_no_uncounted_memory() {
    in_own_process("a_starting_interpreter_sends_no_signals_and_has_no_uncounted_memory", || {
        let parent = getppid().unwrap();
        test_kill_process(parent).unwrap();
        assert_eq!(sandbox_filter::apply_before_interpreter(true).holds, Holds::Yes);
        assert_eq!(test_kill_process(parent), Err(Errno::PERM));
        test_kill_process(getpid()).unwrap();
        assert_eq!(memfd_create("more", MemfdFlags::CLOEXEC).unwrap_err(), Errno::PERM);
    });
}

/// A file that is shared memory, as the control page of a reader.
fn shared_memory() -> File {
    let file = File::from(memfd_create("page", MemfdFlags::CLOEXEC).unwrap());
    file.set_len(4096).unwrap();
    file
}

/// Tries calls that take pages of shared memory from other processes.
fn take_pages(file: &File) -> [Result<(), Errno>; 5] {
    let hole = FallocateFlags::PUNCH_HOLE | FallocateFlags::KEEP_SIZE;
    let advise = |advice| {
        // SAFETY: no bytes are named.
        match unsafe { libc::madvise(std::ptr::null_mut(), 0, advice) } {
            0 => Ok(()),
            _ => Err(Errno::from_io_error(&Error::last_os_error()).unwrap()),
        }
    };
    let [remove, cold, page_out, collapse] =
        [libc::MADV_REMOVE, libc::MADV_COLD, libc::MADV_PAGEOUT, libc::MADV_COLLAPSE].map(advise);
    [fallocate(file, hole, 0, 4096), remove, cold, page_out, collapse]
}

#[test]
fn a_starting_interpreter_takes_no_pages_from_other_processes() {
    in_own_process("a_starting_interpreter_takes_no_pages_from_other_processes", || {
        let file = shared_memory();
        assert_eq!(take_pages(&file)[..2], [Ok(()); 2]);
        assert_eq!(sandbox_filter::apply_before_interpreter(true).holds, Holds::Yes);
        assert_eq!(take_pages(&file), [Err(Errno::PERM); 5]);
    });
}

#[test]
fn a_lambda_takes_no_pages_from_other_processes() {
    in_own_process("a_lambda_takes_no_pages_from_other_processes", || {
        let file = shared_memory();
        sandbox_filter::apply(false).unwrap();
        assert_eq!(take_pages(&file), [Err(Errno::PERM); 5]);
        // Allocators give memory back, and ask for large pages.
        for advice in [libc::MADV_DONTNEED, libc::MADV_FREE, libc::MADV_HUGEPAGE] {
            // SAFETY: no bytes are named.
            assert_eq!(unsafe { libc::madvise(std::ptr::null_mut(), 0, advice) }, 0);
        }
    });
}

#[test]
fn no_process_takes_real_time_priority() {
    in_own_process("no_process_takes_real_time_priority", || {
        base_filter::apply();
        let none = Rlimit { current: Some(0), maximum: Some(0) };
        assert_eq!(getrlimit(Resource::Rtprio), none);
        let priority = libc::sched_param { sched_priority: 1 };
        // SAFETY: the call reads `priority`, which lives until it returns.
        let result = unsafe { libc::sched_setscheduler(0, libc::SCHED_FIFO, &raw const priority) };
        assert_eq!((result, Error::last_os_error().kind()), (-1, ErrorKind::PermissionDenied));
    });
}

#[test]
fn no_process_keeps_the_real_time_priority_of_its_starter() {
    in_own_process("no_process_keeps_the_real_time_priority_of_its_starter", || {
        let priority = libc::sched_param { sched_priority: 1 };
        // SAFETY: the call reads `priority`, which lives until it returns.
        let has =
            unsafe { libc::sched_setscheduler(0, libc::SCHED_FIFO, &raw const priority) } == 0;
        // SAFETY: the calls take numbers by value; 0 is the calling thread.
        let policy = || unsafe { libc::sched_getscheduler(0) };
        // SAFETY: as above. The class for disks is at bit 13, as of `ionice -c 1 -n 3`.
        let io = |call, priority: i32| unsafe { libc::syscall(call, 1, 0, priority) } >> 13;
        let has_io = io(libc::SYS_ioprio_set, 0x2003) == 0;
        println!("real-time priority: {has}, for disks: {has_io}");
        ingress::start(&Paths::default(), true);
        assert!(!has || policy() == libc::SCHED_FIFO, "it was requested");
        assert!(!has_io || io(libc::SYS_ioprio_get, 0) == 1);
        assert!(!base_filter::apply().iter().any(|layer| layer.name == "real-time priority"));
        assert_eq!(policy(), libc::SCHED_OTHER);
        assert!([0, 2].contains(&io(libc::SYS_ioprio_get, 0)), "none, or the usual one");
    });
}

#[test]
fn memory_in_use_does_not_raise_a_limit_above_an_earlier_one() {
    in_own_process("memory_in_use_does_not_raise_a_limit_above_an_earlier_one", || {
        let bound = || getrlimit(Resource::Data).maximum.unwrap();
        memory::limit(512 << 20);
        let first = bound();
        let taken = black_box(Vec::<u8>::with_capacity(256 << 20));
        assert!(black_box(Vec::<u8>::new()).try_reserve_exact(6 << 30).is_err());
        memory::limit(128 << 20);
        let second = bound();
        assert!(second < first && second > 256 << 20, "{first} {second}");
        memory::limit(6 << 30);
        assert_eq!(bound(), second);
        drop(taken);
    });
}

/// Checks that each layer holds; those of Landlock, as far as this kernel has it.
#[track_caller]
fn hold(layers: &[Layer]) {
    let missing = |layer: &&Layer| match layer.holds {
        Holds::Yes => false,
        Holds::Partly | Holds::No => !layer.note.contains("Landlock"),
    };
    assert_eq!(layers.iter().find(missing), None);
}

#[track_caller]
fn refused<T>(result: std::io::Result<T>) {
    assert_eq!(result.err().map(|error| error.kind()), Some(ErrorKind::PermissionDenied));
}

#[test]
fn a_process_without_sockets_still_has_its_own_and_pairs() {
    in_own_process("a_process_without_sockets_still_has_its_own_and_pairs", || {
        let socket = UdpSocket::bind("127.0.0.1:0").unwrap();
        hold(&[sockets::deny()]);
        refused(UdpSocket::bind("127.0.0.1:0"));
        refused(TcpStream::connect("127.0.0.1:9"));
        refused(UnixStream::connect("/nowhere"));
        let address = socket.local_addr().unwrap();
        socket.send_to(b"x", address).unwrap();
        assert_eq!(socket.recv(&mut [0; 2]).unwrap(), 1);
        let (mut near, _far) = UnixStream::pair().unwrap();
        near.write_all(b"x").unwrap();
    });
}

#[test]
fn the_ingress_has_datagrams_memory_and_threads_but_no_programs_and_streams() {
    in_own_process(
        "the_ingress_has_datagrams_memory_and_threads_but_no_programs_and_streams",
        || {
            let drive = std::env::current_exe().unwrap();
            let paths = Paths { read: vec![drive.clone()], write: Vec::new() };
            let layers = ingress::start(&paths, false);
            // A thread from before, as those of DDS.
            let (go, goes) = mpsc::channel::<()>();
            let earlier = thread::spawn(move || {
                goes.recv().unwrap();
                refused(Command::new("/bin/true").spawn());
                refused(TcpStream::connect("127.0.0.1:9"));
            });
            let layers = ingress::close(layers, NewSockets::Udp).unwrap();
            hold(&layers);
            go.send(()).unwrap();
            earlier.join().unwrap();
            thread::spawn(|| ()).join().unwrap();
            UdpSocket::bind("127.0.0.1:0").unwrap();
            memfd_create("topic", MemfdFlags::CLOEXEC).unwrap();
            refused(UnixStream::connect("/nowhere"));
            assert_eq!(test_kill_process(getppid().unwrap()), Err(Errno::PERM));
            if files_hold(&layers) {
                File::open(drive).unwrap();
                refused(File::open("/etc/passwd"));
                refused(File::create(std::env::temp_dir().join("gleaner-ingress-escaped")));
            }
        },
    );
}

#[test]
fn an_ingress_that_plays_a_drive_has_no_sockets() {
    in_own_process("an_ingress_that_plays_a_drive_has_no_sockets", || {
        let layers = ingress::start(&Paths::default(), false);
        hold(&ingress::close(layers, NewSockets::None).unwrap());
        refused(UdpSocket::bind("127.0.0.1:0"));
    });
}

#[test]
fn a_process_with_a_gpu_listens_locally_and_connects_to_nothing() {
    in_own_process("a_process_with_a_gpu_listens_locally_and_connects_to_nothing", || {
        let own_threads = "/proc/self/task";
        let paths = Paths { read: Vec::new(), write: vec![own_threads.into()] };
        let layers = inference::close(inference::start(&paths), true).unwrap();
        hold(&layers);
        thread::Builder::new()
            .spawn(move || {
                let id = rustix::thread::gettid().as_raw_nonzero();
                fs::write(format!("{own_threads}/{id}/comm"), "cuda").unwrap();
            })
            .unwrap()
            .join()
            .unwrap();
        let packets = || socket(AddressFamily::UNIX, SocketType::SEQPACKET, None);
        let listener = packets().unwrap();
        let name = format!("gleaner-jail-{}", std::process::id());
        let name = SocketAddrUnix::new_abstract_name(name.as_bytes()).unwrap();
        bind(&listener, &name).unwrap();
        listen(&listener, 1).unwrap();
        assert_eq!(connect(packets().unwrap(), &name), Err(Errno::PERM));
        for kind in [SocketType::STREAM, SocketType::DGRAM] {
            assert_eq!(socket(AddressFamily::UNIX, kind, None).err(), Some(Errno::PERM));
        }
        refused(UdpSocket::bind("127.0.0.1:0"));
        refused(TcpStream::connect("127.0.0.1:9"));
        if files_hold(&layers) {
            let path = std::env::temp_dir().join("gleaner-inference-escaped");
            let path = SocketAddrUnix::new(&path).unwrap();
            assert_eq!(bind(packets().unwrap(), &path), Err(Errno::ACCESS));
        }
    });
}

#[test]
fn the_recorder_writes_into_its_folder_only() {
    in_own_process("the_recorder_writes_into_its_folder_only", || {
        let folder = std::env::temp_dir().join(format!("gleaner-jail-{}", std::process::id()));
        fs::create_dir_all(folder.join("clips")).unwrap();
        let layers = recorder::enter(std::slice::from_ref(&folder));
        hold(&layers);
        fs::write(folder.join("clips/a.partial"), "x").unwrap();
        fs::rename(folder.join("clips/a.partial"), folder.join("a")).unwrap();
        refused(UdpSocket::bind("127.0.0.1:0"));
        refused(Command::new("/bin/true").spawn());
        thread::spawn(|| ()).join().unwrap();
        if files_hold(&layers) {
            refused(File::create(std::env::temp_dir().join("gleaner-recorder-escaped")));
        }
        fs::remove_dir_all(folder.join("clips")).unwrap();
        fs::remove_file(folder.join("a")).unwrap();
    });
}

fn files_hold(layers: &[Layer]) -> bool {
    layers.iter().any(|layer| layer.name.contains("files") && layer.note.contains("Landlock:"))
}
