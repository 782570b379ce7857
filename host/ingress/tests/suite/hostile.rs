//! Readers that break the rules.
#![allow(unsafe_code)]

use std::fs::File;
use std::io::Write;
use std::os::fd::OwnedFd;
use std::os::unix::net::UnixStream;

use gleaner_buffers::shared::ControlMemory;
use gleaner_protocol::ingress::{IngressLink, ReaderMessage};
use gleaner_protocol::link::Incoming;
use gleaner_samples::regions::ControlRegion;
use gleaner_test_support::random::XorShift64;

use crate::support::{RunningIngress, grant, wait_for};

/// Words of a control page that a hostile reader overwrites: more than it is granted.
const GARBAGE_WORDS: usize = 16;

#[test]
fn garbage_on_a_socket_ends_only_that_reader() {
    let (mut numbers, mut ingress) = RunningIngress::of_numbers("/number");
    let mut honest = ingress.reading("honest", grant(0, "/number"));
    let mut random = XorShift64(0x9e37_79b9_7f4a_7c15);
    for round in 0..50 {
        let mut socket = UnixStream::from(ingress.socket("hostile", vec![grant(0, "/number")]));
        let garbage: Vec<u8> = (0..100 * (round + 1)).map(|_| random.number() as u8).collect();
        // It fails if the ingress has closed the connection already.
        let _ = socket.write_all(&garbage);
        // A frame that seems valid, with a length that is never sent.
        let _ = socket.write_all(&[0, 0, 4, 0, 64, 1]);
        let sent = numbers.publish_all(3);
        assert_eq!(honest.new_numbers(), sent);
    }
    ingress.status(|status| status.readers == 1);
}

#[test]
fn a_reader_that_never_reads_delays_no_one() {
    let (mut numbers, mut ingress) = RunningIngress::of_numbers("/number");
    let _silent: Vec<OwnedFd> = (0..20)
        .map(|n| ingress.socket(&format!("silent {n}"), vec![grant(0, "/number")]))
        .collect();
    let mut honest = ingress.reading("honest", grant(0, "/number"));
    for _ in 0..3 {
        let sent = numbers.publish_all(60);
        assert_eq!(honest.new_numbers(), sent);
        ingress.status(|status| status.readers == 21);
    }
}

/// Receives the control page of a reader, and overwrites it as an untrusted process can.
fn control_page(socket: OwnedFd) -> (IngressLink, ControlRegion) {
    let (mut link, _requests) = IngressLink::new(socket);
    let page = wait_for(|| match link.poll().unwrap() {
        Incoming::Message(delivery) => {
            assert_eq!(delivery.message, ReaderMessage::Welcome);
            delivery.descriptor
        }
        _ => None,
    });
    let page = ControlRegion::open(File::from(page)).unwrap();
    (link, page)
}

#[test]
fn garbage_on_control_pages_neither_tears_samples_nor_stops_the_ingress() {
    let samples = if std::env::var_os("GLEANER_LONG").is_some() { 2_000_000 } else { 50_000 };
    let (mut numbers, mut ingress) = RunningIngress::of_numbers("/number");
    let mut honest = ingress.reading("honest", grant(0, "/number"));
    let stop = std::sync::atomic::AtomicBool::new(false);
    let pages: Vec<_> = (0..3)
        .map(|n| control_page(ingress.socket(&format!("hostile {n}"), vec![grant(0, "/number")])))
        .collect();
    std::thread::scope(|scope| {
        for (seed, (_link, page)) in (1..).zip(&pages) {
            let stop = &stop;
            scope.spawn(move || {
                let mut random = XorShift64(0x9e37_79b9_7f4a_7c15_u64.wrapping_mul(seed));
                while !stop.load(std::sync::atomic::Ordering::Relaxed) {
                    for word in 0..GARBAGE_WORDS {
                        overwrite(page, word, random.number());
                    }
                    std::thread::yield_now();
                }
            });
        }
        let mut checked = 0_u64;
        for n in 0..samples {
            numbers.publish(8 + n % 56);
            if n % 16 == 0 {
                honest.next = honest.topic.reader.head().saturating_sub(16);
                for (seq, bytes) in honest.new_samples() {
                    assert!(bytes.iter().all(|byte| *byte == seq as u8), "torn");
                    checked += 1;
                }
            }
        }
        stop.store(true, std::sync::atomic::Ordering::Relaxed);
        println!("{samples} published, {checked} checked");
        assert!(checked > 0);
    });
    let status = ingress.status(|status| status.readers == 4);
    assert_eq!(status.topics.len(), 1);
    assert_eq!(ingress.end().topics[0].received, samples as u64);
}

fn overwrite(page: &ControlRegion, word: usize, value: u64) {
    // SAFETY: this reader holds nothing.
    unsafe { page.overwrite(word, value) };
}
