//! Choice of a listening port.

use std::io::ErrorKind;
use std::net::{IpAddr, SocketAddr, TcpListener};

use crate::{Error, Result};

/// Number of further ports that are tried where the requested one is in use.
const TRIED: u16 = 50;

/// Listens on a port, or on the next free one; 0 selects any.
///
/// # Errors
/// [`Error::Input`]: none of the ports is free, or the address does not belong to this machine.
pub fn listen(host: IpAddr, port: u16) -> Result<TcpListener> {
    let last = port.saturating_add(TRIED);
    for port in port..=last {
        match TcpListener::bind(SocketAddr::new(host, port)) {
            Ok(listener) => return Ok(listener),
            Err(error) if error.kind() == ErrorKind::AddrInUse => {}
            Err(error) => {
                return Err(Error::Input(format!(
                    "{} cannot be listened on: {error}; choose another port or host",
                    SocketAddr::new(host, port)
                )));
            }
        }
    }
    Err(Error::Input(format!(
        "all ports from {port} to {last} of {host} are in use; choose another port"
    )))
}

#[cfg(test)]
mod tests {
    use super::*;
    use std::net::Ipv4Addr;

    #[test]
    fn the_next_free_port_is_taken() {
        let host = IpAddr::from(Ipv4Addr::LOCALHOST);
        let first = listen(host, 0).unwrap();
        let port = first.local_addr().unwrap().port();
        // The last port has no successor.
        if port < u16::MAX {
            let second = listen(host, port).unwrap().local_addr().unwrap().port();
            assert!(second > port && second <= port.saturating_add(TRIED), "{port} {second}");
        }
    }

    #[test]
    fn an_address_of_another_machine_is_named() {
        // An address of the documentation block, which belongs to no machine.
        let error = listen([192, 0, 2, 1].into(), 8090).unwrap_err().to_string();
        assert!(
            error.contains("192.0.2.1:8090") && error.contains("another port or host"),
            "{error}"
        );
    }
}
